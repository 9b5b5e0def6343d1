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
        video=checked(
            lambda wildcards: str(capture_named(wildcards.capture).video(wildcards.throw, wildcards.camera))
        ),
    output:
        timeline=f"{RESULTS}/{{capture}}/frames/{{throw}}/{{camera}}.json",
        sheet=f"{RESULTS}/{{capture}}/frames/{{throw}}/{{camera}}.png",
    wildcard_constraints:
        capture=OWN_CAPTURE,
    params:
        rate=filmed_rate,
        name=lambda wildcards: f"{wildcards.capture}, {wildcards.throw}, {wildcards.camera}",
    script:
        "../scripts/capture_frames.py"


rule capture_poses:
    input:
        photographs=of_capture(capture_photographs),
        stills=of_capture(capture_stills),
        lenses=of_capture(lambda capture: capture_file(capture, capture.settings.lens)),
        given=of_capture(given_poses),
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
        poses=of_capture(lambda capture: capture.settings.poses),
        seed=of_capture(lambda capture: capture.settings.seed),
        board=of_capture(
            lambda capture: (capture.settings.board.plain() if capture.settings.poses == "board" else None)
        ),
    script:
        "../scripts/capture_poses.py"


rule capture_room:
    input:
        photographs=of_capture(capture_photographs),
        stills=of_capture(capture_stills),
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
        timelines=of_videos("json"),
        sheets=of_videos("png"),
    output:
        page=f"{RESULTS}/{{capture}}/capture.md",
    params:
        title="{capture}",
        videos=of_capture(filmed_by),
    script:
        "../scripts/capture_page.py"
