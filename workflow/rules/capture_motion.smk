"""Masks of photographs and videos, time offsets between cameras, and free flight of a capture. Needs captures.smk."""


rule saliency_network:
    output:
        network=f"{DATA}/weights/u2netp.onnx",
    script:
        "../scripts/saliency_network.py"


ROOM = captured_file(f"{DATA}/{{room}}/room/transforms.json")
ROOM_REPORT = captured_file(f"{RESULTS}/{{room}}/room.json")


rule capture_photograph_masks:
    input:
        room=ROOM,
        report=ROOM_REPORT,
        poses=f"{RESULTS}/{{capture}}/poses.json",
        points=f"{RESULTS}/{{capture}}/points.ply",
        network=of_capture(saliency_network),
        marked=of_capture(marked_photographs),
        own=of_capture(lambda capture: list(map(str, capture.own_masks("photographs").values()))),
    output:
        transforms=f"{DATA}/{{capture}}/static/transforms.json",
        report=f"{RESULTS}/{{capture}}/masks/photographs.json",
        sheet=f"{RESULTS}/{{capture}}/masks/photographs.png",
    wildcard_constraints:
        capture=OWN_CAPTURE,
    conda:
        CAPTURE_ENVIRONMENT
    params:
        longest=capture_setting("longest"),
        board=of_capture(lambda capture: capture.settings.board and capture.settings.board.plain()),
        center=capture_setting("center"),
        object=capture_setting("object"),
        labels=of_capture(lambda capture: capture.labels),
        name="{capture}",
    script:
        "../scripts/capture_photograph_masks.py"


rule capture_video_masks:
    input:
        video=VIDEO_FILE,
        timeline=f"{VIDEO_FRAMES}.json",
        room=ROOM,
        report=ROOM_REPORT,
        own=of_video(
            lambda capture, take, camera: list(map(str, capture.own_masks(f"{take}/{camera}").values()))
        ),
    output:
        transforms=MATTES,
        report=f"{VIDEO_MASKS}.json",
        sheet=f"{VIDEO_MASKS}.png",
    wildcard_constraints:
        capture=FILMED_CAPTURE,
    conda:
        CAPTURE_ENVIRONMENT
    resources:
        mem_mb=2000,
    params:
        camera="{camera}",
        labels=of_capture(lambda capture: capture.labels),
        body=of_capture(lambda capture: capture.body),
        duration=capture_setting("duration"),
        longest=capture_setting("longest"),
        name="{capture}, {take}, {camera}",
    script:
        "../scripts/capture_video_masks.py"


rule capture_flight:
    input:
        videos=TAKE_VIDEOS,
        transforms=of_take_cameras(MATTES),
        reports=of_take_cameras(f"{VIDEO_MASKS}.json"),
        timelines=of_take_cameras(f"{VIDEO_FRAMES}.json"),
        room=ROOM_REPORT,
    output:
        flight=f"{FLIGHT}.json",
        picture=f"{FLIGHT}.png",
    wildcard_constraints:
        capture=FILMED_CAPTURE,
    conda:
        CAPTURE_ENVIRONMENT
    params:
        cameras=TAKE_CAMERAS,
        timing=camera_timing,
        metric=of_capture(lambda capture: capture.settings.metric),
        hidden=of_capture(lambda capture: bool(capture.labels)),  # by another body
        name="{capture}, {take}",
    script:
        "../scripts/capture_flight.py"


rule capture_motion_page:
    input:
        photographs=f"{RESULTS}/{{capture}}/masks/photographs.json",
        photograph_sheet=f"{RESULTS}/{{capture}}/masks/photographs.png",
        reports=of_body_videos(f"{VIDEO_MASKS}.json"),
        sheets=of_body_videos(f"{VIDEO_MASKS}.png"),
        flights=of_takes(f"{FLIGHT}.json"),
        pictures=of_takes(f"{FLIGHT}.png"),
    output:
        page=f"{RESULTS}/{{capture}}/motion.md",
    params:
        title="{capture}: masks and free flight",
        videos=of_capture(body_videos_of),
        takes=of_capture(take_titles),
    script:
        "../scripts/capture_motion_page.py"
