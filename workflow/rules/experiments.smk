"""Laws learned in scenes, put to use elsewhere: on another shape, several on one grid, or for longer."""


rule experiment_truth:
    input:
        kernels=kernels("geometry", "simulation"),
    output:
        particles=f"{DATA}/experiments/{{experiment}}/truth.h5",
    wildcard_constraints:
        experiment="|".join(SETTINGS.experiments) or "none",
    resources:
        gpu=EITHER_GPU,
    params:
        bodies=experiment_bodies("shape", "size", "height", "center", "velocity", "spin", "density", "law"),
        simulation=truth_simulation,
        dt=lambda wildcards: SETTINGS.experiment_dt(wildcards.experiment),
        frames=experiment_frames,
        particles=truth_particles,
        tracers=SETTINGS.dataset.tracers,
        seed=SETTINGS.dataset.seed,
        device=EITHER_DEVICE,
    script:
        "../scripts/ground_truth.py"


rule experiment_start:
    input:
        kernels=kernels("geometry"),
        particles=reconstructed_files("particles.h5"),
        binding=reconstructed_files("binding.h5"),
        gaussians=reconstructed_files("gaussians.ply"),
        mesh=reconstructed_files("mesh.ply"),
        velocity=reconstructed_files("velocity.json"),
    output:
        particles=f"{RESULTS}/experiments/{{experiment}}/particles.h5",
        binding=f"{RESULTS}/experiments/{{experiment}}/binding.h5",
        gaussians=f"{RESULTS}/experiments/{{experiment}}/gaussians.ply",
        mesh=f"{RESULTS}/experiments/{{experiment}}/mesh.ply",
        velocity=f"{RESULTS}/experiments/{{experiment}}/velocity.json",
    params:
        bodies=experiment_bodies(
            "scene", "reconstructed", "shape", "size", "height", "center", "velocity", "spin", "appearance"
        ),
        particles=SETTINGS.geometry.particles,
        sampling=SETTINGS.geometry.sampling,
        seed=seed_of("particles"),
    script:
        "../scripts/experiment_start.py"


use rule tracers as experiment_tracers with:
    output:
        tracers=f"{RESULTS}/experiments/{{experiment}}/tracers.h5",


use rule evaluate as evaluate_experiment with:
    input:
        unpack(of_bodies(model_files)),
        **body_files(),
        kernels=of_bodies(model_kernels),
        truth=of_scene("truth.h5"),
        tracers=of_chain("tracers.h5"),
        velocity=of_chain("velocity.json"),
    output:
        rollout=f"{RESULTS}/experiments/{{experiment}}/{{method}}/rollout.h5",
        metrics=f"{RESULTS}/experiments/{{experiment}}/{{method}}/metrics.json",
    params:
        method=of_bodies(model_parameter),
        simulation=experiment_simulation,
        densities=of_bodies(lambda bodies: [case.density(case.moved) for case in bodies]),
        total=of_bodies(carries_total),
        carrier=of_bodies(shared_carrier),
        frames=experiment_frames,
        device=SETTINGS.device,
        code=code_of("evaluate.py"),
