"""Splats that were made elsewhere: their Gaussians and surface, and their motion under learned laws (docs/splats.md)."""


def splat_setting(choose):
    """A function of wildcards: something of the settings of their scene's splat."""
    return checked(lambda wildcards: choose(SETTINGS.scene(wildcards.scene)))


@checked
def splat_start(wildcards):
    """The start of a splat; its law comes from elsewhere, as it has no video to learn one from."""
    scene, method = wildcards.scene, wildcards.method
    prior_alone = not SETTINGS.method_material(scene, method).train and not (
        SETTINGS.true_law(scene, method) or SETTINGS.is_identified(method) or SETTINGS.is_pac_nerf(method)
    )
    if SETTINGS.law_scene(scene, method) == scene and not prior_alone:
        raise InputError(
            f"{scene}/{method}: a splat has no video to learn a law from; take that of another scene, "
            f"{method}+law_from=<scene>, or the prior alone, nclaw"
        )
    return of_chain("velocity.json")(wildcards)


@checked
def splat_simulation(wildcards):
    dt, _ = SETTINGS.motion_clock(wildcards.scene, wildcards.method)
    return simulator(dt)


@checked
def splat_frames(wildcards):
    _, frames = SETTINGS.motion_clock(wildcards.scene, wildcards.method)
    return list(frames)


rule splat_gaussians:
    input:
        splat=splat_setting(lambda scene: scene.splat.file),
    output:
        gaussians=f"{RESULTS}/{{scene}}/gaussians.ply",
        report=f"{RESULTS}/{{scene}}/gaussians.json",
    wildcard_constraints:
        scene=SPLAT_SCENE,
    params:
        splat=splat_setting(lambda scene: scene.splat.plain()),
        place=scene_setting("size", "height", "center"),
        seed=seed_of("gaussians"),
    script:
        "../scripts/splat_gaussians.py"


rule splat_mesh:
    input:
        kernels=kernels("rendering"),
        gaussians=of_chain("gaussians.ply"),
    output:
        mesh=f"{RESULTS}/{{scene}}/mesh.ply",
    wildcard_constraints:
        scene=SPLAT_SCENE,
    params:
        views=splat_setting(lambda scene: scene.splat.views),
        pixels=splat_setting(lambda scene: scene.splat.pixels),
        surface=SETTINGS.geometry.surface.plain(),
    script:
        "../scripts/splat_mesh.py"


rule splat_binding:
    input:
        gaussians=of_chain("gaussians.ply"),
        sampled=of_chain("sampled_particles.h5"),
    output:
        binding=f"{RESULTS}/{{scene}}/binding.h5",
        particles=f"{RESULTS}/{{scene}}/particles.h5",
    wildcard_constraints:
        scene=SPLAT_SCENE,
    params:
        binding=SETTINGS.binding.plain(),
        own_particles=splat_setting(lambda scene: scene.splat.own_particles),
    script:
        "../scripts/splat_binding.py"


rule splat_velocity:
    output:
        velocity=f"{RESULTS}/{{scene}}/velocity.json",
    wildcard_constraints:
        scene=SPLAT_SCENE,
    params:
        start=scene_setting("velocity", "spin"),
    script:
        "../scripts/splat_velocity.py"


rule splat_motion:
    input:
        **body_files(),
        kernels=kernels("laws"),
        velocity=splat_start,
        prior=material_prior,
        adaptor=trained_adaptor,
        identified=identified_law,
    output:
        rollout=f"{RESULTS}/{{scene}}/{{method}}/rollout.h5",
        report=f"{RESULTS}/{{scene}}/{{method}}/motion.json",
    wildcard_constraints:
        scene=SPLAT_SCENE,
        method=LAW_METHOD,
    resources:
        gpu=GPU,
    params:
        simulation=splat_simulation,
        density=scene_setting("density"),
        laws=lambda wildcards: [law for law in [true_law(wildcards)] if law],
        total=carries_total,
        carrier=experiment_carrier,
        frames=splat_frames,
        device=SETTINGS.device,
    script:
        "../scripts/splat_motion.py"
