"""Released captures of Spring-Gaus and of NeuMA's authors, with cameras and masks. Needs capture_motion.smk."""


rule released_photographs:
    input:
        folders=released_folders,
    output:
        transforms=f"{DATA}/{{capture}}/static/transforms.json",
        report=f"{RESULTS}/{{capture}}/masks/photographs.json",
        sheet=f"{RESULTS}/{{capture}}/masks/photographs.png",
    wildcard_constraints:
        capture=RELEASED_CAPTURE,
    conda:
        CAPTURE_ENVIRONMENT
    params:
        settings=released_settings,
        name="{capture}",
    script:
        "../scripts/released_photographs.py"


rule released_video:
    input:
        folders=released_folders,
    output:
        transforms=MATTES,
        report=f"{VIDEO_MASKS}.json",
        timeline=f"{RESULTS}/{{capture}}/frames/{{throw}}/{{camera}}.json",
        sheet=f"{VIDEO_MASKS}.png",
    wildcard_constraints:
        capture=RELEASED_CAPTURE,
    conda:
        CAPTURE_ENVIRONMENT
    params:
        settings=released_settings,
        name="{capture}",
        camera="{camera}",
    script:
        "../scripts/released_video.py"


# All cameras share a clock. The world is not metric, so gravity is reported but not checked.
use rule capture_flight as released_flight with:
    input:
        transforms=of_throw(MATTES),
        reports=of_throw(f"{VIDEO_MASKS}.json"),
        timelines=of_throw(f"{RESULTS}/{{capture}}/frames/{{throw}}/{{camera}}.json"),
    wildcard_constraints:
        capture=RELEASED_CAPTURE,
    params:
        cameras=filmed_cameras,
        timing=one_clock,
        metric=False,
        name="{capture}, {throw}",
