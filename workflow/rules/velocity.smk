"""Initial velocity from the frames before contact (paper Sec. 3.1)."""


rule velocity:
    input:
        kernels=kernels("laws", "rendering"),
        transforms=f"{DATA}/{{scene}}/dynamic/transforms.json",
        gaussians=f"{RESULTS}/{{scene}}/gaussians.ply",
        binding=f"{RESULTS}/{{scene}}/binding.h5",
        prior=lambda wildcards: prior_file(SETTINGS.scenes[wildcards.scene].prior),
    output:
        velocity=f"{RESULTS}/{{scene}}/velocity.json",
    log:
        f"{LOGS}/{{scene}}/velocity.log",
    benchmark:
        f"{BENCHMARKS}/{{scene}}/velocity.tsv"
    conda:
        ENVIRONMENT
    threads: 1
    resources:
        gpu=GPU,
        mem_mb=4000,
        runtime=60,
    params:
        simulation=simulation_settings,
        density=scene_setting("density"),
        velocity=SETTINGS.velocity.plain(),
        device=SETTINGS.device,
        code=code("velocity"),
    script:
        "../scripts/velocity.py"
