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


rule body_gaussians:
    input:
        kernels=kernels("rendering"),
        gaussians=f"{RESULTS}/{{scene}}/gaussians.ply",
        transforms=of_data("static/transforms.json"),
    output:
        gaussians=f"{RESULTS}/{{scene}}/bodies/{{body}}.ply",
    wildcard_constraints:
        scene=PILE_SCENE,
        body="[^/]+",
    params:
        bodies=of_section(lambda scene: list(scene.bodies)),
    script:
        "../scripts/body_gaussians.py"
