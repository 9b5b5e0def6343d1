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
