"""How well a law predicts the motion, in numbers and to look at. Only here (and in w/ P.S.) is the truth read."""


rule initial_state:
    input:
        kernels=kernels("geometry"),
        truth=of_scene("particles.h5"),
        gaussians=of_chain("gaussians.json"),
        mesh=of_chain("mesh.ply"),
        particles=of_chain("particles.h5"),
        velocity=of_chain("velocity.json"),
    output:
        report=f"{RESULTS}/{{scene}}/initial_state.json",
    wildcard_constraints:
        scene=TRUE_SCENE,
    params:
        scene=scene_setting("shape", "size", "height", "center", "velocity", "spin", "density"),
        particles=SETTINGS.simulation.particles,
    script:
        "../scripts/initial_state.py"


rule tracers:
    input:
        kernels=kernels("geometry"),
        truth=of_scene("particles.h5"),
        mesh=of_chain("mesh.ply"),
    output:
        tracers=f"{RESULTS}/{{scene}}/tracers.h5",
    wildcard_constraints:
        scene=TRUE_SCENE,
    params:
        tracers=SETTINGS.evaluation.tracers,
        seed=SETTINGS.seed,
    script:
        "../scripts/tracers.py"


rule evaluation:
    input:
        **body_files(),
        kernels=kernels_and_field("laws"),
        truth=of_scene("particles.h5"),
        tracers=of_chain("tracers.h5"),
        field=own_field,
        velocity=start_file,
        prior=material_prior,
        adaptor=trained_adaptor,
        identified=identified_law,
    output:
        rollout=f"{RESULTS}/{{scene}}/{{method}}/rollout.h5",
        metrics=f"{RESULTS}/{{scene}}/{{method}}/metrics.json",
    wildcard_constraints:
        scene=TRUE_SCENE,
        method=LAW_METHOD,
    resources:
        gpu=GPU,
    params:
        simulation=simulation_settings,
        densities=lambda wildcards: [method_density(wildcards)],
        laws=lambda wildcards: [law for law in [true_law(wildcards)] if law],
        total=carries_total,
        carrier=judged_carrier,
        own=own_carrying,
        frames=frame_steps,
        device=SETTINGS.device,
    script:
        "../scripts/evaluation.py"


rule video:
    input:
        **body_files(),
        kernels=kernels_and_field("rendering"),
        transforms=of_scene("dynamic/transforms.json"),
        rollout=f"{RESULTS}/{{scene}}/{{method}}/rollout.h5",
        field=own_field,
    output:
        video=f"{RESULTS}/{{scene}}/{{method}}/video.mp4",
    resources:
        gpu=GPU,
    params:
        density=scene_setting("density"),
        carrier=judged_carrier,
        own=own_carrying,
        gaussian_motion=gaussian_motion,
        view=SETTINGS.evaluation.video_view,
        frame_rate=SETTINGS.evaluation.frame_rate,
        magnify=SETTINGS.evaluation.video_magnify,
        filming=filming,
        device=SETTINGS.device,
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
    script:
        "../scripts/viewer.py"
