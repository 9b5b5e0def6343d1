"""Bodies of springs (Spring-Gaus): fitted and judged in place of a material law. Needs methods.smk."""


rule springs:
    input:
        **body_files(),
        kernels=kernels("springs", "rendering"),
        transforms=of_scene("dynamic/transforms.json"),
        velocity=start_file,
    output:
        springs=f"{RESULTS}/{{scene}}/{{method}}/springs.safetensors",
        history=f"{RESULTS}/{{scene}}/{{method}}/history.json",
    wildcard_constraints:
        method=SPRING_METHOD,
    resources:
        gpu=GPU,
    params:
        simulation=simulation_settings,
        density=method_density,
        material=material_settings,
        springs=springs_settings,
        checkpoint=lambda wildcards: f"{RESULTS}/{wildcards.scene}/{wildcards.method}/checkpoint.pt",
        filming=filming,
        device=SETTINGS.device,
    script:
        "../scripts/springs.py"


rule springs_evaluation:
    input:
        **body_files(),
        kernels=kernels("springs"),
        truth=of_scene("particles.h5"),
        tracers=of_chain("tracers.h5"),
        velocity=start_file,
        springs=fitted_springs,
    output:
        rollout=f"{RESULTS}/{{scene}}/{{method}}/rollout.h5",
        metrics=f"{RESULTS}/{{scene}}/{{method}}/metrics.json",
    wildcard_constraints:
        scene=TRUE_SCENE,
        method=SPRING_METHOD,
    resources:
        gpu=GPU,
    params:
        simulation=simulation_settings,
        densities=lambda wildcards: [method_density(wildcards)],
        springs=springs_settings,
        other_body=False,
        frames=frame_steps,
        device=SETTINGS.device,
    script:
        "../scripts/springs_evaluation.py"


rule springs_prediction:
    input:
        **body_files(),
        kernels=kernels("springs"),
        transforms=f"{DATA}/{{scene}}/dynamic/transforms.json",
        velocity=start_file,
        springs=fitted_springs,
    output:
        rollout=f"{RESULTS}/{{scene}}/{{method}}/rollout.h5",
    wildcard_constraints:
        scene=THROW_SCENE,
        method=SPRING_METHOD,
    resources:
        gpu=GPU,
    params:
        simulation=simulation_settings,
        density=method_density,
        views=scene_views,
        springs=springs_settings,
        filming=filming,
        device=SETTINGS.device,
    script:
        "../scripts/springs_prediction.py"


# The same object followed for longer, or another one of the same material: one stiffness with the modulus of the first.
use rule springs_evaluation as springs_experiment with:
    input:
        **body_files(),
        kernels=kernels("springs"),
        truth=of_scene("particles.h5"),
        tracers=of_chain("tracers.h5"),
        velocity=of_chain("velocity.json"),
        springs=fitted_springs,
    output:
        rollout=f"{RESULTS}/experiments/{{experiment}}/{{method}}/rollout.h5",
        metrics=f"{RESULTS}/experiments/{{experiment}}/{{method}}/metrics.json",
    params:
        simulation=experiment_simulation,
        densities=of_each_body(method_density),
        springs=springs_settings,
        other_body=lambda wildcards: SETTINGS.experiment(wildcards.experiment).bodies[0].shape is not None,
        frames=experiment_frames,
        device=SETTINGS.device,
