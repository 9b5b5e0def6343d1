"""Static Gaussian kernels from the views at t = 0 (paper Sec. 3.1)."""


rule gaussians:
    input:
        kernels=kernels("rendering"),
        transforms=f"{DATA}/{{scene}}/static/transforms.json",
    output:
        gaussians=f"{RESULTS}/{{scene}}/gaussians.ply",
        report=f"{RESULTS}/{{scene}}/gaussians.json",
    log:
        f"{LOGS}/{{scene}}/gaussians.log",
    benchmark:
        f"{BENCHMARKS}/{{scene}}/gaussians.tsv"
    conda:
        ENVIRONMENT
    threads: 1
    resources:
        gpu=GPU,
        mem_mb=4000,
        runtime=60,
    params:
        fit=SETTINGS.gaussians.plain(),
        seed=SETTINGS.seed,
        device=SETTINGS.device,
        code=code("gaussians"),
    script:
        "../scripts/gaussians.py"
