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
        scene=LONE_SCENE,
    resources:
        gpu=GPU,
    params:
        simulation=simulation_settings,
        densities=densities_of(lambda scene: [scene]),
        velocity=SETTINGS.velocity.plain(),
        exposure=exposure,
        device=SETTINGS.device,
    script:
        "../scripts/velocity.py"


# Where bodies touch each other follows from the motion of all.
use rule velocity as velocity_of_bodies with:
    input:
        **{name: of_each_body(of_replicate(file)) for name, file in BODY.items()},
        kernels=kernels("laws", "rendering"),
        transforms=of_each_body(of_data("dynamic/transforms.json")),
        obstacles=obstacle_meshes,
        prior=checked(
            lambda wildcards: paths.prior_file(
                SETTINGS, wildcards.scene, SETTINGS.scene(wildcards.scene).prior
            )
        ),
    output:
        velocity=f"{RESULTS}/{{scene}}/motions.json",
    wildcard_constraints:
        scene=DRAWN_PILE,
    params:
        simulation=simulation_settings,
        densities=densities_of(SETTINGS.body_scenes),
        velocity=SETTINGS.velocity.plain(),
        exposure=exposure,
        device=SETTINGS.device,


rule body_velocity:
    input:
        motions=of_pile(of_replicate("motions.json")),
    output:
        velocity=f"{RESULTS}/{{scene}}/velocity.json",
    wildcard_constraints:
        scene=DRAWN_PART,
    params:
        bodies=of_pile(of_section(lambda scene: list(scene.bodies))),
        body=of_section(lambda scene: scene.part_of[1]),
    script:
        "../scripts/body_velocity.py"
