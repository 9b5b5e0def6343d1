"""Which experiment to do next with an object whose material has been identified."""


rule next:
    input:
        **{name: of_each_video(of_replicate(file)) for name, file in BODY.items()},
        kernels=kernels("geometry", "laws", "rendering"),
        transforms=of_each_video(of_data("dynamic/transforms.json")),
        velocity=of_each_video(of_replicate("velocity.json")),
        identified=of_replicate("identified.json"),
        predicted=of_predicted(
            lambda own: [of_replicate(file)(own) for file in (*BODY.values(), "velocity.json")]
        ),
        obstacles=meshes_of_videos,
    output:
        page=f"{RESULTS}/{{scene}}/next.md",
        record=f"{RESULTS}/{{scene}}/next.json",
        picture=f"{RESULTS}/{{scene}}/next.png",
    threads: identify_threads
    resources:
        gpu=GPU,
    params:
        simulation=of_each_video(simulation_settings),
        densities=densities_of(SETTINGS.video_scenes),
        identify=identify_settings,
        next=SETTINGS.next.plain(),
        predicted=of_predicted(
            lambda own: {
                "simulation": simulation_settings(own),
                "density": densities_of(SETTINGS.body_scenes)(own)[0],
                "frames": frame_steps(own),
            }
        ),
        rendered=of_section(lambda scene: scene.has_truth and scene.images.dynamic is None),
        scale=of_section(lambda scene: scene.captured.scale if scene.captured else 1.0),
        seed=SETTINGS.seed,
        exposure=exposure,
        device=SETTINGS.device,
    script:
        "../scripts/next.py"
