"""Comparison of predictions with the videos of takes, and the report of a capture. Needs capture_motion.smk."""

SHOWN = f"{DATA}/{{scene}}/shown/transforms.json"


rule capture_shown:
    input:
        videos=of_thrown(throw_videos),
        mattes=of_filmed(MATTES),
        dynamic=f"{DATA}/{{scene}}/dynamic/transforms.json",
        registration=f"{RESULTS}/{{scene}}/registration.json",
        room=of_thrown(lambda capture: f"{DATA}/{capture.capture}/room/transforms.json"),
        report=of_thrown(lambda capture: f"{RESULTS}/{capture.capture}/room.json"),
    output:
        transforms=SHOWN,
    wildcard_constraints:
        scene=OWN_THROW,
    conda:
        CAPTURE_ENVIRONMENT
    params:
        cameras=scene_cameras,
        rates=lambda wildcards: [
            of_thrown(lambda capture: filmed_rate(SimpleNamespace(**vars(capture), camera=camera)))(
                wildcards
            )
            for camera in scene_cameras(wildcards)
        ],
        longest=of_thrown_capture(lambda capture: capture.settings.longest),
        width=SETTINGS.captures.shown,
    script:
        "../scripts/capture_shown.py"


rule released_shown:
    input:
        folders=of_thrown(released_folders),
        mattes=of_filmed(MATTES),
        dynamic=f"{DATA}/{{scene}}/dynamic/transforms.json",
        registration=f"{RESULTS}/{{scene}}/registration.json",
    output:
        transforms=SHOWN,
    wildcard_constraints:
        scene=RELEASED_THROW,
    conda:
        CAPTURE_ENVIRONMENT
    params:
        cameras=scene_cameras,
        settings=of_thrown(released_settings),
        name=of_thrown(lambda capture: capture.capture),
        longest=of_thrown_capture(lambda capture: capture.settings.longest),
        width=SETTINGS.captures.shown,
    script:
        "../scripts/released_shown.py"


rule capture_view:
    input:
        **body_files(),
        kernels=kernels("rendering"),
        weights=f"{DATA}/weights/lpips.safetensors",
        shown=SHOWN,
        rollout=f"{RESULTS}/{{scene}}/{{method}}/rollout.h5",
        prior=prior_rollout,
    output:
        video=f"{RESULTS}/{{scene}}/{{method}}/views/{{camera}}.mp4",
        measures=f"{RESULTS}/{{scene}}/{{method}}/views/{{camera}}.json",
    wildcard_constraints:
        scene=THROW_SCENE,
    resources:
        gpu=GPU,
    params:
        view=scene_view,
        title=lambda wildcards: method_names(wildcards)[wildcards.method].partition(",")[0],
        density=scene_setting("density"),
        carrier=of_bodies(shared_carrier),
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
        measures=measured_files("json"),
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
                for each in reported_methods(method)
                for file in report_law(name, each)["files"].values()
            ]
        ),
    output:
        curves=f"{RESULTS}/{{capture}}/{{method}}/stress_curves.json",
        picture=f"{RESULTS}/{{capture}}/{{method}}/stress_curves.png",
    params:
        method="{method}",
        titles=method_names,
        laws=of_report(
            lambda name, method: {each: report_law(name, each) for each in reported_methods(method)}
        ),
        dt=of_capture(lambda capture: capture.settings.dt),
        scale=of_capture(lambda capture: capture.settings.scale),
        rate=SETTINGS.figures.shear_rate,
        total_shear=SETTINGS.figures.total_shear,
        model_std=SETTINGS.identify.model_std,
        spread=SETTINGS.identify.spread,
        seed=SETTINGS.seed,
        code=code_of_methods("capture_curves.py"),
    script:
        "../scripts/capture_curves.py"


rule capture_report:
    input:
        room=f"{RESULTS}/{{capture}}/room.json",
        cameras=f"{RESULTS}/{{capture}}/cameras.png",
        floor=f"{RESULTS}/{{capture}}/floor.png",
        timelines=of_videos("json"),
        frame_sheets=of_videos("png"),
        photographs=f"{RESULTS}/{{capture}}/masks/photographs.json",
        photograph_sheet=f"{RESULTS}/{{capture}}/masks/photographs.png",
        masks=of_videos("json", "masks"),
        mask_sheets=of_videos("png", "masks"),
        flights=of_throws(f"{FLIGHT}.json"),
        flight_pictures=of_throws(f"{FLIGHT}.png"),
        object=f"{RESULTS}/{{capture}}/gaussians.json",
        registrations=thrown_files("registration.json"),
        registration_pictures=thrown_files("registration.png"),
        predictions=own_files("prediction.json"),
        films=own_files("views/{camera}.mp4", cameras=True),
        images=f"{RESULTS}/{{capture}}/{{method}}/images.json",
        table=f"{RESULTS}/{{capture}}/{{method}}/images.csv",
        curves=f"{RESULTS}/{{capture}}/{{method}}/stress_curves.json",
        curves_picture=f"{RESULTS}/{{capture}}/{{method}}/stress_curves.png",
        identified=of_report(report_identified),
    output:
        page=f"{RESULTS}/{{capture}}/{{method}}/report.html",
    wildcard_constraints:
        capture=OWN_CAPTURE,
    params:
        capture="{capture}",
        method="{method}",
        titles=method_names,
        prior=PRIOR,
        constants=CONSTANTS,
        videos=of_capture(filmed_by),
        facts=of_report(report_facts),
    script:
        "../scripts/capture_report.py"


# Poses and masks come with the files and are not part of the report.
use rule capture_report as released_report with:
    input:
        timelines=of_videos("json"),
        photographs=f"{RESULTS}/{{capture}}/masks/photographs.json",
        photograph_sheet=f"{RESULTS}/{{capture}}/masks/photographs.png",
        masks=of_videos("json", "masks"),
        mask_sheets=of_videos("png", "masks"),
        flights=of_throws(f"{FLIGHT}.json"),
        flight_pictures=of_throws(f"{FLIGHT}.png"),
        object=f"{RESULTS}/{{capture}}/gaussians.json",
        registrations=thrown_files("registration.json"),
        registration_pictures=thrown_files("registration.png"),
        predictions=own_files("prediction.json"),
        films=own_files("views/{camera}.mp4", cameras=True),
        images=f"{RESULTS}/{{capture}}/{{method}}/images.json",
        table=f"{RESULTS}/{{capture}}/{{method}}/images.csv",
        curves=f"{RESULTS}/{{capture}}/{{method}}/stress_curves.json",
        curves_picture=f"{RESULTS}/{{capture}}/{{method}}/stress_curves.png",
        identified=of_report(report_identified),
    wildcard_constraints:
        capture=RELEASED_CAPTURE,
