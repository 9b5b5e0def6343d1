"""Static Gaussians from the views at t = 0 (paper Sec. 3.1)."""


rule gaussians:
    input:
        kernels=kernels("rendering"),
        transforms=of_data("static/transforms.json"),
    output:
        gaussians=f"{RESULTS}/{{scene}}/gaussians.ply",
        report=f"{RESULTS}/{{scene}}/gaussians.json",
    wildcard_constraints:
        scene=PICTURED_SCENE,
    resources:
        gpu=GPU,
    params:
        fit=SETTINGS.gaussians.plain(),
        photographs=SETTINGS.photographs.plain(),
        seed=seed_of("gaussians"),
        device=SETTINGS.device,
    script:
        "../scripts/gaussians.py"
