"""Measures of rendered images: PSNR, SSIM and LPIPS against the observation."""


rule lpips_weights:
    output:
        weights=f"{DATA}/weights/lpips.safetensors",
    log:
        f"{LOGS}/lpips_weights.log",
    benchmark:
        f"{BENCHMARKS}/lpips_weights.tsv"
    conda:
        ENVIRONMENT
    threads: 1
    resources:
        gpu=0,
        mem_mb=2000,
        runtime=20,
    params:
        code=code("lpips_weights"),
    script:
        "../scripts/lpips_weights.py"


rule image_metrics:
    input:
        kernels=kernels("rendering"),
        weights=f"{DATA}/weights/lpips.safetensors",
        transforms=f"{DATA}/{{scene}}/dynamic/transforms.json",
        gaussians=f"{RESULTS}/{{scene}}/gaussians.ply",
        binding=f"{RESULTS}/{{scene}}/binding.h5",
        rollout=f"{RESULTS}/{{scene}}/{{method}}/rollout.h5",
    output:
        metrics=f"{RESULTS}/{{scene}}/{{method}}/image_metrics.json",
    log:
        f"{LOGS}/{{scene}}/{{method}}/image_metrics.log",
    benchmark:
        f"{BENCHMARKS}/{{scene}}/{{method}}/image_metrics.tsv"
    conda:
        ENVIRONMENT
    threads: 1
    resources:
        gpu=GPU,
        mem_mb=4000,
        runtime=60,
    params:
        density=scene_setting("density"),
        views=evaluation_views,
        margin=SETTINGS.evaluation.margin,
        device=SETTINGS.device,
        code=code("image_metrics"),
    script:
        "../scripts/image_metrics.py"
