"""Laws learned in scenes, put to use elsewhere: on another shape, several on one grid, or for longer. And the bodies
of a scene of several, put together."""


rule experiment_start:
    input:
        kernels=kernels("geometry"),
        particles=reconstructed_files("particles.h5"),
        binding=reconstructed_files("binding.h5"),
        gaussians=reconstructed_files("gaussians.ply"),
        mesh=reconstructed_files("mesh.ply"),
        velocity=reconstructed_files("velocity.json"),
        meshes=solid_meshes(every=False),
    output:
        particles=f"{RESULTS}/{{scene}}/particles.h5",
        binding=f"{RESULTS}/{{scene}}/binding.h5",
        gaussians=f"{RESULTS}/{{scene}}/gaussians.ply",
        mesh=f"{RESULTS}/{{scene}}/mesh.ply",
        velocity=f"{RESULTS}/{{scene}}/velocity.json",
    wildcard_constraints:
        scene=f"{EXPERIMENT}|{PILE_SCENE}",
    params:
        bodies=body_settings(
            "scene", "reconstructed", "shape", "size", "height", "center", "velocity", "spin", "appearance"
        ),
        separate=has_separate_bodies,
        particles=SETTINGS.geometry.particles,
        sampling=SETTINGS.geometry.sampling,
        seed=seed_of("particles"),
    script:
        "../scripts/experiment_start.py"
