"""Errors and videos of predicted motions. Only these rules (and the row w/ P.S.) read the truth."""


rule initial_state:
    input:
        kernels=kernels("geometry"),
        truth=of_data("truth.h5"),
        gaussians=of_replicate("gaussians.json"),
        mesh=of_replicate("mesh.ply"),
        particles=of_replicate("particles.h5"),
        velocity=of_replicate("velocity.json"),
        meshes=solid_meshes(),
    output:
        report=f"{RESULTS}/{{scene}}/initial_state.json",
    wildcard_constraints:
        scene=LONE_SCENE,
    params:
        scene=scene_setting("shape", "size", "height", "center", "rotation", "velocity", "spin", "density"),
        particles=SETTINGS.geometry.particles,
    script:
        "../scripts/initial_state.py"


rule tracers:
    input:
        kernels=kernels("geometry"),
        truth=of_data("truth.h5"),
        mesh=of_replicate("mesh.ply"),
    output:
        tracers=f"{RESULTS}/{{scene}}/tracers.h5",
    wildcard_constraints:
        scene=f"{TRUE_SCENE}|{PILE_SCENE}|{EXPERIMENT}",
    params:
        # one of several bodies has its share of the tracers of all
        tracers=lambda wildcards: (
            None
            if not of_experiment(wildcards) and SETTINGS.scene(wildcards.scene).part_of
            else SETTINGS.evaluation.tracers
        ),
        seed=SETTINGS.seed,
    script:
        "../scripts/tracers.py"


rule evaluate:
    input:
        unpack(of_bodies(model_files)),
        **body_files(),
        kernels=of_bodies(model_kernels),
        truth=of_data("truth.h5"),
        tracers=of_replicate("tracers.h5"),
        velocity=evaluated_start,
        obstacles=obstacle_meshes,
    output:
        rollout=f"{RESULTS}/{{scene}}/{{method}}/rollout.h5",
        metrics=f"{RESULTS}/{{scene}}/{{method}}/metrics.json",
    wildcard_constraints:
        scene=f"{TRUE_SCENE}|{PILE_SCENE}|{EXPERIMENT}",
    resources:
        gpu=GPU,
    params:
        method=of_bodies(model_parameter),
        simulation=simulation_settings,
        densities=of_bodies(lambda bodies: [case.density(case.moved) for case in bodies]),
        total=of_bodies(carries_total),
        particle_source=evaluated_particle_source,
        frames=frame_steps,
        device=SETTINGS.device,
        code=code_of("evaluate.py"),
    script:
        "../scripts/evaluate.py"


# Scenes without a truth: takes of captures. `predict_splat` is the same for splats.
rule predict:
    input:
        unpack(of_bodies(model_files)),
        **body_files(),
        kernels=of_bodies(model_kernels),
        transforms=f"{DATA}/{{scene}}/dynamic/transforms.json",
        velocity=capture_start,
        obstacles=obstacle_meshes,
    output:
        rollout=f"{RESULTS}/{{scene}}/{{method}}/rollout.h5",
        report=f"{RESULTS}/{{scene}}/{{method}}/prediction.json",
    wildcard_constraints:
        scene=TAKE_SCENE,
    resources:
        gpu=GPU,
    params:
        method=of_bodies(model_parameter),
        simulation=simulation_settings,
        densities=of_bodies(lambda bodies: [case.density(case.moved) for case in bodies]),
        total=of_bodies(carries_total),
        particle_source=of_bodies(shared_particle_source),
        frames=None,
        cameras=scene_cameras,
        scale=of_section(lambda scene: scene.captured.scale),
        exposure=exposure,
        device=SETTINGS.device,
        code=code_of("predict.py"),
    script:
        "../scripts/predict.py"


rule video:
    input:
        unpack(of_bodies(lambda bodies: bodies[0].method.body_inputs(bodies[0]))),
        **body_files(),
        kernels=of_bodies(lambda bodies: body_kernels(bodies[0])),
        transforms=of_data("dynamic/transforms.json"),
        rollout=f"{RESULTS}/{{scene}}/{{method}}/rollout.h5",
    output:
        video=f"{RESULTS}/{{scene}}/{{method}}/video.mp4",
    resources:
        gpu=GPU,
    params:
        density=scene_setting("density"),
        method=of_bodies(lambda bodies: body_parameter(bodies[0])),
        particle_source=of_bodies(particle_source),
        gaussian_motion=gaussian_motion,
        view=SETTINGS.evaluation.video_view,
        frame_rate=SETTINGS.evaluation.frame_rate,
        magnify=SETTINGS.evaluation.video_magnify,
        exposure=exposure,
        device=SETTINGS.device,
        code=code_of("video.py"),
    script:
        "../scripts/video.py"


rule viewer:
    input:
        files=lambda wildcards: viewer_files(wildcards).files,
        kernels=kernels("laws", "rendering"),
    output:
        page=f"{RESULTS}/{{scene}}/viewer.html",
    params:
        files=lambda wildcards: viewer_files(wildcards).plain(),
        viewer=SETTINGS.viewer.plain(),
        code=code_of_methods("viewer.py"),
    script:
        "../scripts/viewer.py"
