"""Training videos of captures: a take in simulation time. Needs capture_motion.smk."""


rule capture_video:
    input:
        transforms=of_filmed(MATTES),
        timelines=of_filmed(f"{RESULTS}/{{capture}}/frames/{{throw}}/{{camera}}.json"),
        registration=f"{RESULTS}/{{scene}}/registration.json",
    output:
        transforms=f"{DATA}/{{scene}}/dynamic/transforms.json",
    wildcard_constraints:
        scene=THROW_SCENE,
    params:
        cameras=lambda wildcards: SETTINGS.scene(wildcards.scene).captured.cameras,
        timing=of_thrown(camera_timing),
        exposures=of_thrown(camera_exposures),
        dt=scene_setting("dt"),
        duration=of_thrown_capture(lambda capture: capture.settings.duration),
        frames=of_thrown_capture(lambda capture: capture.settings.frames),
        width=of_thrown_capture(lambda capture: capture.settings.width),
        name="{scene}",
    script:
        "../scripts/capture_video.py"
