"""Gaussians to particles (paper Algorithm 1)."""


rule binding:
    input:
        gaussians=f"{RESULTS}/{{scene}}/gaussians.ply",
        particles=f"{RESULTS}/{{scene}}/particles.h5",
    output:
        binding=f"{RESULTS}/{{scene}}/binding.h5",
    log:
        f"{LOGS}/{{scene}}/binding.log",
    benchmark:
        f"{BENCHMARKS}/{{scene}}/binding.tsv"
    conda:
        ENVIRONMENT
    threads: 1
    resources:
        gpu=0,
        mem_mb=4000,
        runtime=10,
    params:
        binding=SETTINGS.binding.plain(),
        code=code("binding"),
    script:
        "../scripts/binding.py"
