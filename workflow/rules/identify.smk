"""Family and constants of the material in the video: a start of training, or a law."""

# A file that names its views is for methods that train on other views than the rest.
for views in ("", "+views={views}"):

    rule:
        name:
            "identify_views" if views else "identify"
        input:
            **{name: of_each_video(of_replicate(file)) for name, file in BODY.items()},
            kernels=kernels("binding", "geometry", "laws", "rendering"),
            mesh=of_each_video(of_replicate("mesh.ply")),
            transforms=of_each_video(of_data("dynamic/transforms.json")),
            velocity=of_each_video(of_replicate("velocity.json")),
            obstacles=meshes_of_videos,
        output:
            identified=f"{RESULTS}/{{scene}}/identified{views}.json",
        wildcard_constraints:
            scene=SINGLE_SCENE,
        priority: 1
        threads: identify_threads
        resources:
            gpu=GPU,
        params:
            simulation=of_each_video(simulation_settings),
            densities=densities_of(SETTINGS.video_scenes),
            binding=SETTINGS.binding.plain(),
            identify=identify_settings,
            seed=seed_of("particles"),
            published=published_law,
            exposure=exposure,
            device=SETTINGS.device,
        script:
            "../scripts/identify.py"


rule identify_bodies:
    input:
        **{name: of_each_body(of_replicate(file)) for name, file in BODY.items()},
        kernels=kernels("laws", "rendering"),
        transforms=of_data("dynamic/transforms.json"),
        velocity=of_each_body(of_replicate("velocity.json")),
        obstacles=obstacle_meshes,
    output:
        identified=f"{RESULTS}/{{scene}}/identified.json",
    wildcard_constraints:
        scene=PILE_SCENE,
    threads: identify_threads
    resources:
        gpu=GPU,
    params:
        bodies=of_section(lambda scene: list(scene.bodies)),
        simulation=simulation_settings,
        densities=densities_of(SETTINGS.body_scenes),
        identify=identify_settings,
        given=of_section(lambda scene: {name: b.family for name, b in scene.bodies.items() if b.family}),
        exposure=exposure,
        device=SETTINGS.device,
    script:
        "../scripts/identify_bodies.py"


rule identified_page:
    input:
        identified=f"{RESULTS}/{{scene}}/identified.json",
    output:
        page=f"{RESULTS}/{{scene}}/identified.png",
    params:
        law=of_section(lambda scene: scene.plain()["law"]),
    script:
        "../scripts/identified_page.py"


rule identified_table:
    input:
        identified=[result_path(entry["name"], "identified.json") for entry in identified_scenes()],
    output:
        csv=f"{RESULTS}/identified.csv",
        markdown=f"{RESULTS}/identified.md",
    params:
        scenes=identified_scenes(),
    script:
        "../scripts/identified_table.py"


use rule identified_table as identified_behind_table with:
    input:
        identified=lambda wildcards: [
            result_path(entry["name"], "identified.json") for entry in identified_behind(wildcards.table)
        ],
    output:
        csv=f"{RESULTS}/identified_{{table}}.csv",
        markdown=f"{RESULTS}/identified_{{table}}.md",
    params:
        scenes=lambda wildcards: identified_behind(wildcards.table),


rule bodies_table:
    input:
        identified=of_replicate("identified.json"),
        metrics=f"{RESULTS}/{{scene}}/constants/metrics.json",
        true_law=f"{RESULTS}/{{scene}}/true_law/metrics.json",
        alone=of_each_body(of_replicate("identified.json")),
        alone_metrics=of_each_body(lambda wildcards: f"{RESULTS}/{wildcards.scene}/constants/metrics.json"),
    output:
        csv=f"{RESULTS}/{{scene}}/bodies.csv",
        markdown=f"{RESULTS}/{{scene}}/bodies.md",
    wildcard_constraints:
        scene=PILE_SCENE,
    params:
        laws=of_section(lambda scene: {name: body.law.plain() for name, body in scene.bodies.items()}),
        frictions=of_section(lambda scene: [pair.plain() for pair in scene.pairs]),
    script:
        "../scripts/bodies_table.py"
