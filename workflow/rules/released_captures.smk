"""Released captures of Spring-Gaus and of NeuMA's authors, with cameras and masks. Needs capture_motion.smk."""


rule released_photographs:
    input:
        folders=RELEASED_FOLDERS,
    output:
        transforms=f"{DATA}/{{capture}}/static/transforms.json",
        report=f"{RESULTS}/{{capture}}/masks/photographs.json",
        sheet=f"{RESULTS}/{{capture}}/masks/photographs.png",
    wildcard_constraints:
        capture=RELEASED_CAPTURE,
    conda:
        CAPTURE_ENVIRONMENT
    params:
        settings=RELEASED_SETTINGS,
        name="{capture}",
    script:
        "../scripts/released_photographs.py"


rule released_video:
    input:
        folders=RELEASED_FOLDERS,
    output:
        transforms=MATTES,
        report=f"{VIDEO_MASKS}.json",
        timeline=f"{VIDEO_FRAMES}.json",
        sheet=f"{VIDEO_MASKS}.png",
    wildcard_constraints:
        capture=RELEASED_CAPTURE,
    conda:
        CAPTURE_ENVIRONMENT
    params:
        settings=RELEASED_SETTINGS,
        name="{capture}",
        camera="{camera}",
    script:
        "../scripts/released_video.py"


# All cameras share a clock. The world is not metric, so gravity is reported but not checked.
use rule capture_flight as released_flight with:
    input:
        transforms=of_take_cameras(MATTES),
        reports=of_take_cameras(f"{VIDEO_MASKS}.json"),
        timelines=of_take_cameras(f"{VIDEO_FRAMES}.json"),
    wildcard_constraints:
        capture=RELEASED_CAPTURE,
    params:
        cameras=TAKE_CAMERAS,
        timing=of_take(
            lambda capture, take: dict.fromkeys(
                ("offsets", "row_times"), [0.0] * len(capture.cameras_of(take))
            )
        ),
        metric=False,
        name="{capture}, {take}",
