"""Captures that Blender makes: photographs, stills and videos of simulated objects, and their truth. Needs captures.smk."""

from neuma_lib.capture.planned import PREFIX, photograph_files
from neuma_lib.capture.scenes import scene_name, training_throws
from neuma_lib.config.methods import LAW_FROM

DEMO = SETTINGS.captures.demo
DEMO_DATA = f"{DATA}/captures_demo"
DEMO_CAPTURE = f"{CAPTURES}/{PREFIX}{{item}}"
DEMO_CAMERAS = sorted(DEMO.cameras)


wildcard_constraints:
    item="|".join(DEMO.objects) or "none",


def demo_settings(*, of_objects=True):
    """Settings that pictures depend on: those of one object, or of none."""

    def choose(wildcards):
        plain = DEMO.plain()
        plain["objects"] = {wildcards.item: plain["objects"][wildcards.item]} if of_objects else {}
        return plain

    return choose


rule demo_room:
    output:
        room=f"{DEMO_DATA}/room.npz",
    priority: 10  # all that is rendered waits for it
    conda:
        CAPTURE_ENVIRONMENT
    params:
        demo=demo_settings(of_objects=False),
        threads=1,
    script:
        "../scripts/demo_room.py"


rule demo_drop:
    input:
        kernels=kernels("geometry", "simulation"),
    output:
        particles=f"{DEMO_DATA}/{{item}}/{{throw}}.h5",
    resources:
        gpu=EITHER_GPU,
        mem_mb=8000,
    params:
        demo=demo_settings(),
        name="{item}",
        drop="{throw}",
        device=EITHER_DEVICE,
    script:
        "../scripts/demo_drop.py"


rule demo_photographs:
    input:
        room=f"{DEMO_DATA}/room.npz",
    output:
        photographs=[f"{DEMO_CAPTURE}/photos/{file}" for file in photograph_files(DEMO)],
        truth=f"{DEMO_DATA}/{{item}}/photographs.json",
    params:
        demo=demo_settings(),
        name="{item}",
        threads=1,
    script:
        "../scripts/demo_photographs.py"


rule demo_videos:
    input:
        room=f"{DEMO_DATA}/room.npz",
        particles=f"{DEMO_DATA}/{{item}}/{{throw}}.h5",
    output:
        videos=[f"{DEMO_CAPTURE}/videos/{{throw}}/{camera}.mp4" for camera in DEMO_CAMERAS],
    params:
        demo=demo_settings(),
        name="{item}",
        drop="{throw}",
        threads=1,
    script:
        "../scripts/demo_videos.py"


rule demo_capture:
    input:
        room=f"{DEMO_DATA}/room.npz",
        photographs=f"{DEMO_DATA}/{{item}}/photographs.json",
    output:
        stills=[f"{DEMO_CAPTURE}/stills/{camera}.png" for camera in DEMO_CAMERAS],
        settings=f"{DEMO_CAPTURE}/capture.yaml",
        truth=f"{DEMO_DATA}/{{item}}/truth.json",
    params:
        demo=demo_settings(),
        name="{item}",
    script:
        "../scripts/demo_capture.py"


def demo_file(item, file):
    return f"{RESULTS}/{PREFIX}{item}/{file}"


def demo_drop_files(item, drop):
    """What is known of a drop and what was found of it, by kind."""
    capture, trained = PREFIX + item, training_throws(PLANNED[PREFIX + item])[0]
    scene, source = scene_name(capture, drop), scene_name(capture, trained)
    under = "" if drop == trained else f"+{LAW_FROM}={source}"
    filmed = f"{DATA}/{capture}/videos/{drop}/{{}}/transforms.json"
    return {
        "particles": f"{DEMO_DATA}/{item}/{drop}.h5",
        "mattes": {camera: filmed.format(camera) for camera in DEMO_CAMERAS},
        "flight": demo_file(item, f"flight/{drop}.json"),
        "registration": f"{RESULTS}/{scene}/registration.json",
        "velocity": f"{RESULTS}/{scene}/velocity.json",
        "rollouts": {method: f"{RESULTS}/{scene}/{method}{under}/rollout.h5" for method in DEMO.methods},
    }


def demo_files(item):
    """What is known of an object and what was found of it, by kind."""
    return {
        "truth": f"{DEMO_DATA}/{item}/truth.json",
        "room": f"{DATA}/{PREFIX}{item}/room/transforms.json",
        "report": demo_file(item, "room.json"),
        "static": f"{DATA}/{PREFIX}{item}/static/transforms.json",
        "drops": {drop: demo_drop_files(item, drop) for drop in sorted(DEMO.objects[item].drops)},
    }


def flat(files):
    """The files of nested dicts."""
    return [file for each in files.values() for file in (flat(each) if isinstance(each, dict) else [each])]


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
        "../scripts/demo_evaluation.py"


rule captures_demo:
    input:
        rules.demo_evaluation.output,
        [demo_file(item, f"{page}.md") for item in DEMO.objects for page in ("capture", "motion")],
