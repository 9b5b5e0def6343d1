"""The printed board, and frames, cameras and the room of a capture. Needs captures.smk."""


rule capture_board:
    output:
        board=f"{CAPTURES}/board.pdf",
    conda:
        CAPTURE_ENVIRONMENT
    params:
        board=SETTINGS.captures.printed.plain(),
        paper=SETTINGS.captures.paper,
    script:
        "../scripts/capture_board.py"


rule capture_frames:
    input:
        video=VIDEO_FILE,
    output:
        timeline=f"{VIDEO_FRAMES}.json",
        sheet=f"{VIDEO_FRAMES}.png",
    wildcard_constraints:
        capture=FILMED_CAPTURE,
    params:
        rate=VIDEO_RATE,
        name="{capture}, {take}, {camera}",
    script:
        "../scripts/capture_frames.py"


rule capture_poses:
    input:
        photographs=PHOTOGRAPHS,
        stills=STILLS,
        lenses=of_capture(lambda capture: capture_file(capture, capture.settings.lens)),
        given=of_capture(
            lambda capture: capture_file(
                capture,
                None if capture.settings.poses in ("photographs", "board") else capture.settings.poses,
            )
        ),
    output:
        poses=f"{RESULTS}/{{capture}}/poses.json",
        points=f"{RESULTS}/{{capture}}/points.ply",
        picture=f"{RESULTS}/{{capture}}/poses.png",
    wildcard_constraints:
        capture=OWN_CAPTURE,
    conda:
        CAPTURE_ENVIRONMENT
    threads: POSES_THREADS
    resources:
        mem_mb=8000,
        runtime=240,
    params:
        poses=capture_setting("poses"),
        seed=capture_setting("seed"),
        board=of_capture(
            lambda capture: (capture.settings.board.plain() if capture.settings.poses == "board" else None)
        ),
    script:
        "../scripts/capture_poses.py"


rule capture_room:
    input:
        photographs=PHOTOGRAPHS,
        stills=STILLS,
        poses=f"{RESULTS}/{{capture}}/poses.json",
        points=f"{RESULTS}/{{capture}}/points.ply",
    output:
        transforms=f"{DATA}/{{capture}}/room/transforms.json",
        report=f"{RESULTS}/{{capture}}/room.json",
        cameras=f"{RESULTS}/{{capture}}/cameras.png",
        floor=f"{RESULTS}/{{capture}}/floor.png",
    wildcard_constraints:
        capture=OWN_CAPTURE,
    conda:
        CAPTURE_ENVIRONMENT
    params:
        settings=of_capture(room_settings),
    script:
        "../scripts/capture_room.py"


rule capture_page:
    input:
        room=f"{RESULTS}/{{capture}}/room.json",
        cameras=f"{RESULTS}/{{capture}}/cameras.png",
        floor=f"{RESULTS}/{{capture}}/floor.png",
        timelines=of_videos(f"{VIDEO_FRAMES}.json"),
        sheets=of_videos(f"{VIDEO_FRAMES}.png"),
    output:
        page=f"{RESULTS}/{{capture}}/capture.md",
    params:
        title="{capture}",
        videos=of_capture(videos_of),
    script:
        "../scripts/capture_page.py"
