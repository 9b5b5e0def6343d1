"""Demo captures, rendered by Blender: photographs, stills and videos of simulated objects. Needs files.smk."""


wildcard_constraints:
    item="|".join(DEMO.objects) or "none",


rule demo_room:
    output:
        room=f"{DEMO_DATA}/{{item}}/room.npz",
    priority: 10  # all renders wait for it
    conda:
        CAPTURE_ENVIRONMENT
    params:
        demo=demo_settings(),
        name="{item}",
        threads=1,
    script:
        "scripts/demo_room.py"


rule demo_drop:
    input:
        kernels=kernels("geometry", "simulation"),
    output:
        particles=f"{DEMO_DATA}/{{item}}/{{take}}.h5",
    resources:
        gpu=EITHER_GPU,
        mem_mb=8000,
    params:
        demo=demo_settings(),
        name="{item}",
        drop="{take}",
        device=EITHER_DEVICE,
    script:
        "scripts/demo_drop.py"


rule demo_photographs:
    input:
        room=f"{DEMO_DATA}/{{item}}/room.npz",
    output:
        photographs=[f"{DEMO_CAPTURE}/photos/{file}" for file in photograph_files(DEMO)],
        truth=f"{DEMO_DATA}/{{item}}/photographs.json",
    params:
        demo=demo_settings(),
        name="{item}",
        threads=1,
    script:
        "scripts/demo_photographs.py"


rule demo_videos:
    input:
        room=f"{DEMO_DATA}/{{item}}/room.npz",
        particles=f"{DEMO_DATA}/{{item}}/{{take}}.h5",
    output:
        videos=[f"{DEMO_CAPTURE}/videos/{{take}}/{camera}.mp4" for camera in DEMO_CAMERAS],
    params:
        demo=demo_settings(),
        name="{item}",
        drop="{take}",
        threads=1,
    script:
        "scripts/demo_videos.py"


rule demo_capture:
    input:
        room=f"{DEMO_DATA}/{{item}}/room.npz",
        photographs=f"{DEMO_DATA}/{{item}}/photographs.json",
    output:
        stills=[f"{DEMO_CAPTURE}/stills/{camera}.png" for camera in DEMO_CAMERAS],
        settings=f"{DEMO_CAPTURE}/capture.yaml",
        truth=f"{DEMO_DATA}/{{item}}/truth.json",
    params:
        demo=demo_settings(),
        name="{item}",
    script:
        "scripts/demo_capture.py"


rule demo_evaluation:
    input:
        [file for item in DEMO.objects for file in flat(demo_files(item))],
    output:
        page=f"{RESULTS}/captures_demo.md",
        csv=f"{RESULTS}/captures_demo.csv",
    conda:
        CAPTURE_ENVIRONMENT
    params:
        demo=DEMO.plain(),
        captures={item: PREFIX + item for item in DEMO.objects},
        files={item: demo_files(item) for item in DEMO.objects},
        longest={item: PLANNED[PREFIX + item].settings.longest for item in DEMO.objects},
        prior=next(iter(DEMO.methods), None),
    script:
        "scripts/demo_evaluation.py"


rule demo_picture:
    input:
        photographs=[
            f"{DEMO_CAPTURE}/photos/{photograph_files(DEMO)[0]}".format(item=item) for item in DEMO.objects
        ],
        stills=[f"{DEMO_CAPTURE}/stills/{DEMO_CAMERAS[0]}.png".format(item=item) for item in DEMO.objects],
        videos=[
            f"{DEMO_CAPTURE}/videos/{min(DEMO.objects[item].drops)}/{DEMO_CAMERAS[0]}.mp4".format(item=item)
            for item in DEMO.objects
        ],
    output:
        picture=f"{RESULTS}/captures_demo.png",
    conda:
        CAPTURE_ENVIRONMENT
    params:
        names=list(DEMO.objects),
    script:
        "scripts/demo_picture.py"


rule captures_demo:
    default_target: True
    input:
        rules.demo_evaluation.output,
        rules.demo_picture.output,
        [demo_file(item, f"{page}.md") for item in DEMO.objects for page in ("capture", "motion")],
