"""Initial velocity from the frames before contact (paper Sec. 3.1)."""


rule velocity:
    input:
        **body_files(),
        kernels=kernels("laws", "rendering"),
        transforms=of_data("dynamic/transforms.json"),
        obstacles=obstacle_meshes,
        prior=checked(
            lambda wildcards: paths.prior_file(
                SETTINGS, wildcards.scene, SETTINGS.scene(wildcards.scene).prior
            )
        ),
    output:
        velocity=f"{RESULTS}/{{scene}}/velocity.json",
    wildcard_constraints:
        scene=TRUE_SCENE,
    resources:
        gpu=GPU,
    params:
        simulation=simulation_settings,
        density=scene_setting("density"),
        velocity=SETTINGS.velocity.plain(),
        exposure=exposure,
        device=SETTINGS.device,
    script:
        "../scripts/velocity.py"
