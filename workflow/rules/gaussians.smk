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
    priority: 1
    resources:
        gpu=GPU,
    params:
        fit=SETTINGS.gaussians.plain(),
        photographs=SETTINGS.photographs.plain(),
        seed=seed_of("gaussians"),
        device=SETTINGS.device,
    script:
        "../scripts/gaussians.py"


use rule gaussians as gaussians_of_bodies with:
    output:
        gaussians=f"{RESULTS}/{{scene}}/whole.ply",
        report=f"{RESULTS}/{{scene}}/whole.json",
    wildcard_constraints:
        scene=PILE_SCENE,


rule body_gaussians:
    input:
        kernels=kernels("rendering"),
        gaussians=of_pile(of_replicate("whole.ply")),
        transforms=of_pile(of_data("static/transforms.json")),
    output:
        gaussians=f"{RESULTS}/{{scene}}/gaussians.ply",
    wildcard_constraints:
        scene=PART_SCENE,
    params:
        bodies=of_pile(of_section(lambda scene: list(scene.bodies))),
        body=of_section(lambda scene: scene.part_of[1]),
    script:
        "../scripts/body_gaussians.py"
