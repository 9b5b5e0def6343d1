"""Files and settings of the captures that Blender makes. Needs the Snakefile of this study."""

from studies.capture_benchmark.planned import PREFIX, photograph_files
from neuma_lib.project.capture_scenes import scene_name, training_takes

DEMO_DATA = f"{DATA}/captures_demo"
DEMO_CAPTURE = f"{CAPTURES}/{PREFIX}{{item}}"
DEMO_CAMERAS = sorted(DEMO.cameras)


def demo_settings():
    """Settings that pictures of an object depend on."""

    def choose(wildcards):
        plain = DEMO.plain()
        plain["objects"] = {wildcards.item: plain["objects"][wildcards.item]}
        return plain

    return choose


def demo_file(item, file):
    return f"{RESULTS}/{PREFIX}{item}/{file}"


def demo_drop_files(item, drop):
    """What is known of a drop and what was found of it, by kind."""
    capture, trained = PREFIX + item, training_takes(PLANNED[PREFIX + item])[0]
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
