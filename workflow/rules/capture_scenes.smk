"""Training videos of captures: a take in simulation time. Needs capture_motion.smk."""


rule capture_video:
    input:
        transforms=of_take_cameras(MATTES),
        timelines=of_take_cameras(f"{VIDEO_FRAMES}.json"),
        registration=of_each_body(lambda wildcards: f"{RESULTS}/{wildcards.scene}/registration.json"),
    output:
        transforms=f"{DATA}/{{scene}}/dynamic/transforms.json",
    wildcard_constraints:
        scene=FILMED_SCENE,
    params:
        cameras=scene_cameras,
        timing=camera_timing,
        exposures=camera_settings("exposure", 0.0),
        dt=scene_setting("dt"),
        duration=capture_setting("duration"),
        frames=capture_setting("frames"),
        width=capture_setting("width"),
        name="{scene}",
    script:
        "../scripts/capture_video.py"
