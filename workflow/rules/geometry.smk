"""A watertight surface from Gaussians and views, and particles in its volume (paper Sec. 3.1)."""


rule mesh:
    input:
        transforms=f"{DATA}/{{scene}}/static/transforms.json",
        gaussians=f"{RESULTS}/{{scene}}/gaussians.ply",
    output:
        mesh=f"{RESULTS}/{{scene}}/mesh.ply",
    log:
        f"{LOGS}/{{scene}}/mesh.log",
    benchmark:
        f"{BENCHMARKS}/{{scene}}/mesh.tsv"
    conda:
        ENVIRONMENT
    threads: 1
    resources:
        gpu=0,
        mem_mb=4000,
        runtime=30,
    params:
        surface=SETTINGS.geometry.surface.plain(),
        code=code("mesh"),
    script:
        "../scripts/mesh.py"


rule particles:
    input:
        mesh=f"{RESULTS}/{{scene}}/mesh.ply",
    output:
        particles=f"{RESULTS}/{{scene}}/particles.h5",
    log:
        f"{LOGS}/{{scene}}/particles.log",
    benchmark:
        f"{BENCHMARKS}/{{scene}}/particles.tsv"
    conda:
        ENVIRONMENT
    threads: 1
    resources:
        gpu=0,
        mem_mb=2000,
        runtime=10,
    params:
        wanted=SETTINGS.simulation.particles,
        sampling=SETTINGS.geometry.sampling,
        seed=SETTINGS.seed,
        code=code("particles"),
    script:
        "../scripts/particles.py"
