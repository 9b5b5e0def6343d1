"""Splats that were made elsewhere: their Gaussians and surface, and their motion under learned laws (docs/splats.md)."""


rule splat_gaussians:
    input:
        splat=of_section(lambda scene: scene.splat.file),
    output:
        gaussians=f"{RESULTS}/{{scene}}/gaussians.ply",
        report=f"{RESULTS}/{{scene}}/gaussians.json",
    wildcard_constraints:
        scene=SPLAT_SCENE,
    params:
        splat=of_section(lambda scene: scene.splat.plain()),
        place=scene_setting("size", "height", "center"),
        seed=seed_of("gaussians"),
    script:
        "../scripts/splat_gaussians.py"


rule splat_mesh:
    input:
        kernels=kernels("rendering"),
        gaussians=of_replicate("gaussians.ply"),
    output:
        mesh=f"{RESULTS}/{{scene}}/mesh.ply",
    wildcard_constraints:
        scene=SPLAT_SCENE,
    params:
        views=of_section(lambda scene: scene.splat.views),
        pixels=of_section(lambda scene: scene.splat.pixels),
        edge=of_section(lambda scene: scene.splat.edge),
        surface=SETTINGS.geometry.surface.plain(),
    script:
        "../scripts/splat_mesh.py"


rule splat_velocity:
    output:
        velocity=f"{RESULTS}/{{scene}}/velocity.json",
    wildcard_constraints:
        scene=SPLAT_SCENE,
    params:
        start=scene_setting("velocity", "spin"),
    script:
        "../scripts/splat_velocity.py"


use rule predict as predict_splat with:
    input:
        unpack(of_bodies(model_files)),
        **body_files(),
        kernels=of_bodies(model_kernels),
        velocity=splat_start,
        obstacles=obstacle_meshes,
    output:
        rollout=f"{RESULTS}/{{scene}}/{{method}}/rollout.h5",
        report=f"{RESULTS}/{{scene}}/{{method}}/motion.json",
    wildcard_constraints:
        scene=SPLAT_SCENE,
    params:
        method=of_bodies(model_parameter),
        simulation=checked(
            lambda wildcards: simulator(
                wildcards.scene, cases.motion_clock(SETTINGS, wildcards.scene, wildcards.method)[0]
            )
        ),
        densities=of_case(lambda case: [SETTINGS.scene(case.moved).plain()["density"]]),
        total=of_bodies(carries_total),
        particle_source=of_bodies(shared_particle_source),
        frames=splat_clock(lambda dt, frames: list(frames)),
        cameras=None,
        scale=None,
        exposure=None,
        device=SETTINGS.device,
        code=code_of("predict.py"),
