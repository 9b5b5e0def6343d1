"""Measures of rendered images: PSNR, SSIM and LPIPS against the observation."""


rule lpips_weights:
    output:
        weights=f"{DATA}/weights/lpips.safetensors",
    script:
        "../scripts/lpips_weights.py"


rule image_metrics:
    input:
        **body_files(),
        kernels=kernels_and_field("rendering"),
        weights=f"{DATA}/weights/lpips.safetensors",
        transforms=of_scene("dynamic/transforms.json"),
        rollout=f"{RESULTS}/{{scene}}/{{method}}/rollout.h5",
        field=own_field,
    output:
        metrics=f"{RESULTS}/{{scene}}/{{method}}/image_metrics.json",
    resources:
        gpu=GPU,
    params:
        density=scene_setting("density"),
        carrier=judged_carrier,
        own=own_carrying,
        gaussian_motion=gaussian_motion,
        views=evaluation_views,
        training_views=lambda wildcards: material_settings(wildcards)["views"],
        margin=SETTINGS.evaluation.margin,
        filming=filming,
        device=SETTINGS.device,
    script:
        "../scripts/image_metrics.py"
