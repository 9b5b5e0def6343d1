"""Comparison of predictions with the videos of takes, and the report of a capture. Needs capture_motion.smk."""

DISPLAY = f"{DATA}/{{scene}}/shown/transforms.json"


rule capture_display:
    input:
        videos=TAKE_VIDEOS,
        mattes=of_take_cameras(MATTES),
        dynamic=f"{DATA}/{{scene}}/dynamic/transforms.json",
        registration=of_each_body(lambda wildcards: f"{RESULTS}/{wildcards.scene}/registration.json"),
        room=captured_file(f"{DATA}/{{capture}}/room/transforms.json"),
        report=captured_file(f"{RESULTS}/{{capture}}/room.json"),
    output:
        transforms=DISPLAY,
    wildcard_constraints:
        scene=f"(?!{CAPTURED_PART}/){OWN_TAKE}",
    conda:
        CAPTURE_ENVIRONMENT
    params:
        cameras=scene_cameras,
        rates=camera_settings("rate"),
        longest=capture_setting("longest"),
        width=SETTINGS.captures.shown,
    script:
        "../scripts/capture_display.py"


rule released_display:
    input:
        folders=RELEASED_FOLDERS,
        mattes=of_take_cameras(MATTES),
        dynamic=f"{DATA}/{{scene}}/dynamic/transforms.json",
        registration=f"{RESULTS}/{{scene}}/registration.json",
    output:
        transforms=DISPLAY,
    wildcard_constraints:
        scene=RELEASED_TAKE,
    conda:
        CAPTURE_ENVIRONMENT
    params:
        cameras=scene_cameras,
        settings=RELEASED_SETTINGS,
        name=of_capture(lambda capture: capture.folder.name),
        longest=capture_setting("longest"),
        width=SETTINGS.captures.shown,
    script:
        "../scripts/released_display.py"


rule capture_view:
    input:
        **body_files(),
        kernels=kernels("rendering"),
        weights=f"{DATA}/weights/lpips.safetensors",
        display=DISPLAY,
        rollout=f"{RESULTS}/{{scene}}/{{method}}/rollout.h5",
        prior=prior_rollout,
    output:
        video=f"{RESULTS}/{{scene}}/{{method}}/views/{{camera}}.mp4",
        measures=f"{RESULTS}/{{scene}}/{{method}}/views/{{camera}}.json",
    wildcard_constraints:
        scene=TAKE_SCENE,
    resources:
        gpu=GPU,
    params:
        view=scene_view,
        title=lambda wildcards: report_titles(wildcards.method)[wildcards.method].partition(",")[0],
        density=scene_setting("density"),
        particle_source=of_bodies(shared_particle_source),
        gaussian_motion=gaussian_motion,
        prior_motion=lambda wildcards: (
            gaussian_motion(SimpleNamespace(scene=wildcards.scene, method=PRIOR)) if PRIOR else None
        ),
        exposure=exposure,
        margin=SETTINGS.evaluation.margin,
        measured=SETTINGS.captures.measured,
        frame_rate=SETTINGS.evaluation.frame_rate,
        device=SETTINGS.device,
    script:
        "../scripts/capture_view.py"


rule capture_images:
    input:
        measures=of_report(
            lambda name, method: [
                f"{take_run(name, cell['throw'], cell['method'])}/views/{cell['camera']}.json"
                for cell in report_cells(name, method)
            ]
        ),
    output:
        csv=f"{RESULTS}/{{capture}}/{{method}}/images.csv",
        json=f"{RESULTS}/{{capture}}/{{method}}/images.json",
    params:
        cells=of_report(report_cells),
    script:
        "../scripts/capture_images.py"


rule capture_curves:
    input:
        kernels=kernels("laws"),
        rollout=of_report(lambda name, method: f"{RESULTS}/{training_scene(name)}/{method}/rollout.h5"),
        laws=of_report(
            lambda name, method: [
                file
                for of_body in report_laws(name, method).values()
                for law in of_body.values()
                for file in {*law["files"].values(), *law["uncertainty"].values()}
            ]
        ),
    output:
        curves=f"{RESULTS}/{{capture}}/{{method}}/stress_curves.json",
        picture=f"{RESULTS}/{{capture}}/{{method}}/stress_curves.png",
    params:
        method="{method}",
        titles=of_report(lambda name, method: report_titles(method)),
        laws=of_report(report_laws),
        dt=capture_setting("dt"),
        scale=capture_setting("scale"),
        rate=SETTINGS.figures.shear_rate,
        total_shear=SETTINGS.figures.total_shear,
        model_std=SETTINGS.identify.model_std,
        spread=SETTINGS.identify.spread,
        seed=SETTINGS.seed,
        code=code_of_methods("capture_curves.py"),
    script:
        "../scripts/capture_curves.py"


# Released captures come with poses and masks, which their reports do not check.
REPORTED = {
    "timelines": of_videos(f"{VIDEO_FRAMES}.json"),
    "photographs": f"{RESULTS}/{{capture}}/masks/photographs.json",
    "photograph_sheet": f"{RESULTS}/{{capture}}/masks/photographs.png",
    "masks": of_body_videos(f"{VIDEO_MASKS}.json"),
    "mask_sheets": of_body_videos(f"{VIDEO_MASKS}.png"),
    "flights": of_takes(f"{FLIGHT}.json"),
    "flight_pictures": of_takes(f"{FLIGHT}.png"),
    "objects": of_capture(lambda capture: list(object_reports(capture).values())),
    "registrations": of_registrations("registration.json"),
    "registration_pictures": of_registrations("registration.png"),
    "predictions": of_report(
        lambda name, method: [
            f"{take_run(name, take, method)}/prediction.json" for take in capture_named(name).takes
        ]
    ),
    "films": of_report(
        lambda name, method: [
            f"{take_run(name, take, method)}/views/{camera}.mp4"
            for take, camera in videos_of(capture_named(name))
        ]
    ),
    "images": f"{RESULTS}/{{capture}}/{{method}}/images.json",
    "table": f"{RESULTS}/{{capture}}/{{method}}/images.csv",
    "curves": f"{RESULTS}/{{capture}}/{{method}}/stress_curves.json",
    "curves_picture": f"{RESULTS}/{{capture}}/{{method}}/stress_curves.png",
    "identified": of_report(report_identified),
}


rule capture_report:
    input:
        **REPORTED,
        room=f"{RESULTS}/{{capture}}/room.json",
        cameras=f"{RESULTS}/{{capture}}/cameras.png",
        floor=f"{RESULTS}/{{capture}}/floor.png",
        frame_sheets=of_videos(f"{VIDEO_FRAMES}.png"),
    output:
        page=f"{RESULTS}/{{capture}}/{{method}}/report.html",
    wildcard_constraints:
        capture=OWN_CAPTURE,
    params:
        capture="{capture}",
        method="{method}",
        titles=of_report(lambda name, method: report_titles(method)),
        prior=PRIOR,
        constants=CONSTANTS,
        videos=of_capture(videos_of),
        filmed=of_capture(body_videos_of),
        motions=of_capture(take_titles),
        objects=of_capture(lambda capture: list(object_reports(capture))),
        facts=of_report(report_facts),
    script:
        "../scripts/capture_report.py"


use rule capture_report as released_report with:
    input:
        **REPORTED,
    wildcard_constraints:
        capture=RELEASED_CAPTURE,
