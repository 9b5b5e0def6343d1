"""Voxel radiance field of the views at t = 0 (PAC-NeRF)."""


rule radiance_field:
    input:
        kernels=kernels("radiance"),
        transforms=of_data("static/transforms.json"),
    output:
        field=f"{RESULTS}/{{scene}}/pac_nerf/field.safetensors",
        report=f"{RESULTS}/{{scene}}/pac_nerf/field.json",
        views=f"{RESULTS}/{{scene}}/pac_nerf/field.png",
    resources:
        gpu=GPU,
    params:
        fit=SETTINGS.radiance.plain(),
        seed=seed_of("gaussians"),
        checkpoint=lambda wildcards: f"{RESULTS}/{wildcards.scene}/pac_nerf/field.checkpoint.pt",
        device=SETTINGS.device,
    script:
        "../scripts/radiance_field.py"
