"""A watertight surface from Gaussians and views, and particles in its volume (paper Sec. 3.1)."""


rule mesh:
    input:
        transforms=of_data("static/transforms.json"),
        gaussians=of_replicate("gaussians.ply"),
    output:
        mesh=f"{RESULTS}/{{scene}}/mesh.ply",
    wildcard_constraints:
        scene=f"{PICTURED_SCENE}|{PART_SCENE}",
    params:
        surface=SETTINGS.geometry.surface.plain(),
        photographs=SETTINGS.photographs.plain(),
    script:
        "../scripts/mesh.py"


rule sampled_particles:
    input:
        kernels=kernels("geometry"),
        mesh=of_replicate("mesh.ply"),
    output:
        particles=f"{RESULTS}/{{scene}}/sampled_particles.h5",
    wildcard_constraints:
        scene=OBJECT_SCENE,
    params:
        wanted=SETTINGS.geometry.particles,
        sampling=SETTINGS.geometry.sampling,
        seed=seed_of("particles"),
    script:
        "../scripts/sampled_particles.py"
