"""Measures of rendered images: PSNR, SSIM and LPIPS against the observation."""


rule lpips_weights:
    output:
        weights=f"{DATA}/weights/lpips.safetensors",
    script:
        "../scripts/lpips_weights.py"


rule image_metrics:
    input:
        unpack(of_case(lambda case: case.method.body_inputs(case))),
        **body_files(),
        kernels=of_case(body_kernels),
        weights=f"{DATA}/weights/lpips.safetensors",
        transforms=of_data("dynamic/transforms.json"),
        rollout=f"{RESULTS}/{{scene}}/{{method}}/rollout.h5",
    output:
        metrics=f"{RESULTS}/{{scene}}/{{method}}/image_metrics.json",
    resources:
        gpu=GPU,
    params:
        density=scene_setting("density"),
        method=of_case(body_parameter),
        particle_source=of_bodies(particle_source),
        gaussian_motion=gaussian_motion,
        views=of_case(evaluation_views),
        training_views=of_case(lambda case: list(case.options.views)),
        margin=SETTINGS.evaluation.margin,
        exposure=exposure,
        device=SETTINGS.device,
        code=code_of("image_metrics.py"),
    script:
        "../scripts/image_metrics.py"
