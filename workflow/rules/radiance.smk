"""PAC-NeRF, with which we compare: its voxel radiance field of the views at t = 0, then velocity and constants. Needs
methods.smk."""

PAC_NERF_METHODS = [name for name in SETTINGS.methods if SETTINGS.is_pac_nerf(name)]
FITTED_METHODS = (
    "|".join(name for name in PAC_NERF_METHODS if SETTINGS.method_training(name) == name) or "none"
)


rule radiance_field:
    input:
        kernels=kernels("radiance"),
        transforms=of_scene("static/transforms.json"),
    output:
        field=f"{RESULTS}/{{scene}}/pac_nerf/field.safetensors",
        report=f"{RESULTS}/{{scene}}/pac_nerf/field.json",
        views=f"{RESULTS}/{{scene}}/pac_nerf/field.png",
    resources:
        gpu=GPU,
    params:
        fit=SETTINGS.radiance.plain(),
        seed=seed_of("gaussians"),
        checkpoint=lambda wildcards: f"{RESULTS}/{wildcards.scene}/pac_nerf/field.checkpoint.pt",
        device=SETTINGS.device,
    script:
        "../scripts/radiance_field.py"


rule pac_nerf:
    input:
        kernels=kernels("laws", "radiance"),
        field=of_chain(FIELD),
        transforms=of_scene("dynamic/transforms.json"),
        velocity=of_chain("velocity.json"),
    output:
        constants=f"{RESULTS}/{{scene}}/{{method}}/constants.json",
        history=f"{RESULTS}/{{scene}}/{{method}}/history.json",
    wildcard_constraints:
        method=f"({FITTED_METHODS})([+][^/]*)?",
    resources:
        gpu=GPU,
    params:
        simulation=simulation_settings,
        density=method_density,
        views=lambda wildcards: material_settings(wildcards)["views"],
        radiance={key: SETTINGS.radiance.plain()[key] for key in ("spacing", "least_opacity")},
        pac_nerf=pac_nerf_settings,
        prior=pac_nerf_prior,
        seed=SETTINGS.seed,
        checkpoint=lambda wildcards: f"{RESULTS}/{wildcards.scene}/{wildcards.method}/checkpoint.pt",
        filming=filming,
        device=SETTINGS.device,
    script:
        "../scripts/pac_nerf.py"
