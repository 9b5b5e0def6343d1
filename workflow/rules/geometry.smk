"""A watertight surface from Gaussians and views, and particles in its volume (paper Sec. 3.1)."""


rule mesh:
    input:
        transforms=f"{DATA}/{{scene}}/static/transforms.json",
        gaussians=f"{RESULTS}/{{scene}}/gaussians.ply",
    output:
        mesh=f"{RESULTS}/{{scene}}/mesh.ply",
    params:
        surface=SETTINGS.geometry.surface.plain(),
    script:
        "../scripts/mesh.py"


rule sampled_particles:
    input:
        kernels=kernels("geometry"),
        mesh=f"{RESULTS}/{{scene}}/mesh.ply",
    output:
        particles=f"{RESULTS}/{{scene}}/sampled_particles.h5",
    params:
        wanted=SETTINGS.simulation.particles,
        sampling=SETTINGS.geometry.sampling,
        seed=SETTINGS.seed,
    script:
        "../scripts/sampled_particles.py"
