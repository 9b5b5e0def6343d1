"""Masks of photographs and videos, time offsets between cameras, and free flight of a capture. Needs captures.smk."""

MATTES = f"{DATA}/{{capture}}/videos/{{throw}}/{{camera}}/transforms.json"
VIDEO_MASKS = f"{RESULTS}/{{capture}}/masks/{{throw}}/{{camera}}"
FLIGHT = f"{RESULTS}/{{capture}}/flight/{{throw}}"


rule saliency_network:
    output:
        network=f"{DATA}/weights/u2netp.onnx",
    script:
        "../scripts/saliency_network.py"


rule capture_photograph_masks:
    input:
        room=f"{DATA}/{{capture}}/room/transforms.json",
        report=f"{RESULTS}/{{capture}}/room.json",
        network=saliency_network,
        own=of_capture(photograph_masks),
    output:
        transforms=f"{DATA}/{{capture}}/static/transforms.json",
        report=f"{RESULTS}/{{capture}}/masks/photographs.json",
        sheet=f"{RESULTS}/{{capture}}/masks/photographs.png",
    wildcard_constraints:
        capture=OWN_CAPTURE,
    conda:
        CAPTURE_ENVIRONMENT
    params:
        longest=of_capture(lambda capture: capture.settings.longest),
        board=of_capture(lambda capture: capture.settings.board and capture.settings.board.plain()),
        center=of_capture(lambda capture: capture.settings.center),
        name="{capture}",
    script:
        "../scripts/capture_photograph_masks.py"


rule capture_video_masks:
    input:
        video=checked(
            lambda wildcards: str(capture_named(wildcards.capture).video(wildcards.throw, wildcards.camera))
        ),
        timeline=f"{RESULTS}/{{capture}}/frames/{{throw}}/{{camera}}.json",
        room=f"{DATA}/{{capture}}/room/transforms.json",
        report=f"{RESULTS}/{{capture}}/room.json",
        own=video_masks,
    output:
        transforms=MATTES,
        report=f"{VIDEO_MASKS}.json",
        sheet=f"{VIDEO_MASKS}.png",
    wildcard_constraints:
        capture=OWN_CAPTURE,
    conda:
        CAPTURE_ENVIRONMENT
    resources:
        mem_mb=8000,
    params:
        camera="{camera}",
        rate=filmed_rate,
        longest=of_capture(lambda capture: capture.settings.longest),
        name="{capture}, {throw}, {camera}",
    script:
        "../scripts/capture_video_masks.py"


rule capture_flight:
    input:
        videos=throw_videos,
        transforms=of_throw(MATTES),
        reports=of_throw(f"{VIDEO_MASKS}.json"),
        timelines=of_throw(f"{RESULTS}/{{capture}}/frames/{{throw}}/{{camera}}.json"),
    output:
        flight=f"{FLIGHT}.json",
        picture=f"{FLIGHT}.png",
    wildcard_constraints:
        capture=OWN_CAPTURE,
    conda:
        CAPTURE_ENVIRONMENT
    params:
        cameras=filmed_cameras,
        timing=camera_timing,
        metric=True,
        name="{capture}, {throw}",
    script:
        "../scripts/capture_flight.py"


rule capture_motion_page:
    input:
        photographs=f"{RESULTS}/{{capture}}/masks/photographs.json",
        photograph_sheet=f"{RESULTS}/{{capture}}/masks/photographs.png",
        reports=of_videos("json", "masks"),
        sheets=of_videos("png", "masks"),
        flights=of_throws(f"{FLIGHT}.json"),
        pictures=of_throws(f"{FLIGHT}.png"),
    output:
        page=f"{RESULTS}/{{capture}}/motion.md",
    params:
        title="{capture}: masks and free flight",
        videos=of_capture(filmed_by),
        throws=of_capture(lambda capture: list(capture.takes)),
    script:
        "../scripts/capture_motion_page.py"
