"""Files and settings of captures (docs/capture.md). Needs scenes.smk."""

from dataclasses import replace
from functools import cache

from neuma_lib.config.variants import NAME, RESERVED
from neuma_lib.project.capture_folder import inside, read_capture
from neuma_lib.project.released_captures import released_captures

CAPTURES = SETTINGS.captures.root.rstrip("/")
CAPTURE_ENVIRONMENT = "../../envs/conda-capture.yaml"
OF_VIDEOS = (
    "stills",
    "throws",
    "cameras",
    "prior",
    "density",
    "dt",
    "held_out",
    "bodies",
    "duration",
    "frames",
    "width",
)
POSES_THREADS = 8  # for matching, or all available ones if fewer
VIDEO = "{take}/{camera}"
MATTES = f"{DATA}/{{capture}}/videos/{VIDEO}/transforms.json"
VIDEO_MASKS = f"{RESULTS}/{{capture}}/masks/{VIDEO}"
VIDEO_FRAMES = f"{RESULTS}/{{capture}}/frames/{VIDEO}"
FLIGHT = f"{RESULTS}/{{capture}}/flight/{{take}}"

# Names of folders with other results.
OTHERS = "|".join([TRUE_SCENE, DRAWN_PILE, SPLAT_SCENE, *RESERVED])
RELEASED_CAPTURE = names_of(SETTINGS.captures.released, replicates=False)
FILMED_CAPTURE = f"(?!({OTHERS}|{RELEASED_CAPTURE})/){NAME.pattern}"  # or one of its bodies
OWN_CAPTURE = f"(?!{CAPTURED_PART}/){FILMED_CAPTURE}"
RELEASED_TAKE = scenes_that(
    lambda scene: scene.captured and scene.captured.capture in SETTINGS.captures.released, replicates=False
)
OWN_TAKE = f"(?!{RELEASED_TAKE}/){TAKE_SCENE}"


wildcard_constraints:
    capture=f"(?!({OTHERS})/){NAME.pattern}",
    take=NAME.pattern,
    camera=NAME.pattern,


@cache
def capture_named(name):
    if name in SETTINGS.captures.released:
        return released_captures({name: SETTINGS.captures.released[name]})[name]
    if name in SETTINGS.scenes and SETTINGS.scenes[name].part_of:
        whole, body = SETTINGS.scenes[name].part_of
        return replace(capture_named(whole), body=body)
    return PLANNED.get(name) or read_capture(f"{CAPTURES}/{name}")


def take_of(wildcards):
    """Capture, and name of the take, of a job whose wildcards name them or the scene of a take."""
    if hasattr(wildcards, "capture"):
        return capture_named(wildcards.capture), getattr(wildcards, "take", None)
    captured = SETTINGS.scene(wildcards.scene).captured
    return capture_named(captured.capture), captured.throw


def of_capture(choose):
    """A function of wildcards: a value of their capture."""
    return checked(lambda wildcards: choose(take_of(wildcards)[0]))


def of_take(choose):
    """A function of wildcards: a value of their capture and take."""
    return checked(lambda wildcards: choose(*take_of(wildcards)))


def of_video(choose):
    """A function of wildcards: a value of their capture, take and camera."""
    return checked(lambda wildcards: choose(*take_of(wildcards), wildcards.camera))


def captured_file(pattern):
    """A function of wildcards: a file of their capture or take, or of the room that all bodies of a capture share."""
    return of_take(
        lambda capture, take: pattern.format(
            capture=capture.name, take=take, room=capture.folder.name, source=photographed(capture)
        )
    )


def photographed(capture):
    """Name of the scene with the photographs of a capture, or of one of its bodies."""
    name, where = capture.source, f"{capture.folder / 'capture.yaml'}: bodies.{capture.body}.capture"
    if capture.body is None:
        return name
    if name not in SETTINGS.scenes or SETTINGS.scenes[name].bodies or not SETTINGS.scenes[name].captured:
        raise InputError(where, f"no capture '{name}' of one body", "Name a folder of captures")
    scales = SETTINGS.scenes[name].captured.scale, capture.settings.scale
    if scales[0] != scales[1]:
        raise InputError(
            where, f"the scale of '{name}' is {scales[0]:g}, but {scales[1]:g} here", "Set one scale"
        )
    return name


def parts_of(capture):
    """The bodies of a capture as captures, or the capture of one body itself."""
    return [replace(capture, body=body) for body in capture.labels] or [capture]


def of_take_bodies(pattern):
    """A function of wildcards: a file of each body of their take."""
    return of_take(
        lambda capture, take: [pattern.format(capture=part.name, take=take) for part in parts_of(capture)]
    )


def of_body_videos(pattern):
    """A function of wildcards: a file for each body in each video of their capture."""
    return of_capture(
        lambda capture: [
            file for part in parts_of(capture) for file in video_files(pattern, part, part.takes)
        ]
    )


def of_take_cameras(pattern):
    """A function of wildcards: a file for each camera of their take."""
    return of_take(lambda capture, take: video_files(pattern, capture, [take]))


def of_videos(pattern):
    """A function of wildcards: a file for each video of their capture."""
    return of_capture(lambda capture: video_files(pattern, capture, capture.takes))


def video_files(pattern, capture, takes):
    name = capture.name
    return [
        pattern.format(capture=name, take=take, camera=camera)
        for take in takes
        for camera in capture.cameras_of(take)
    ]


def of_takes(pattern):
    """A function of wildcards: a file for each take of their capture, or for each body in it."""
    return of_capture(
        lambda capture: [
            pattern.format(capture=part.name, take=take) for part in parts_of(capture) for take in part.takes
        ]
    )


def take_titles(capture):
    """Names of takes, in the order of `of_takes`."""
    return [
        take + (f", {part.body}" if part.body else "") for part in parts_of(capture) for take in part.takes
    ]


def capture_setting(name):
    """A function of wildcards: a setting of their capture."""
    return of_capture(lambda capture: getattr(capture.settings, name))


def camera_settings(name, default=None):
    """A function of wildcards: a setting of each camera of their take."""
    return of_take(
        lambda capture, take: [
            getattr(capture.settings.cameras.get(camera), name, default)
            for camera in capture.cameras_of(take)
        ]
    )


def released_setting(choose):
    """A function of wildcards: something of the settings of their released capture."""
    return of_capture(lambda capture: choose(SETTINGS.captures.released[capture.folder.name]))


def capture_file(capture, name):
    """A file in the capture's folder that the settings name."""
    return [str(inside(capture.folder, name))] if name else []


def videos_of(capture):
    """Take and camera of all videos."""
    return [(take, camera) for take, cameras in capture.takes.items() for camera in cameras]


def body_videos_of(capture):
    """Take, with the body, and camera of all videos, in the order of `of_body_videos`."""
    titled = zip(take_titles(capture), [take for _ in parts_of(capture) for take in capture.takes])
    return [(title, camera) for title, take in titled for camera in capture.takes[take]]


def saliency_network(capture):
    """The network, if a photograph has no mask of the user."""
    own = capture.own_masks("photographs")
    return (
        []
        if capture.labels or all(p.stem in own for p in capture.photographs)
        else [f"{DATA}/weights/u2netp.onnx"]
    )


def marked_photographs(capture):
    """Photographs in which the object is selected, whose EXIF orientation matters."""
    return [str(file) for file in capture.photographs if file.name in capture.settings.object]


def room_settings(capture):
    """Settings that the room depends on. A fitted floor is that of the selected object."""
    unused = {*OF_VIDEOS, "photographs", "masks"} | ({"object"} if capture.settings.board else set())
    return capture.settings.model_dump(mode="json", exclude=unused)


def camera_timing(wildcards):
    """Offset and row time in the settings, for each camera of a take."""
    return {
        "offsets": camera_settings("offset")(wildcards),
        "row_times": camera_settings("row_time", 0.0)(wildcards),
    }


PHOTOGRAPHS = of_capture(lambda capture: list(map(str, capture.pictures()["photographs"])))
STILLS = of_capture(lambda capture: list(map(str, capture.stills.values())))
VIDEO_FILE = of_video(lambda capture, take, camera: str(capture.video(take, camera)))
VIDEO_RATE = of_video(
    lambda capture, take, camera: getattr(capture.settings.cameras.get(camera), "rate", None)
)
TAKE_VIDEOS = of_take(
    lambda capture, take: [str(capture.video(take, camera)) for camera in capture.cameras_of(take)]
)
TAKE_CAMERAS = of_take(lambda capture, take: capture.cameras_of(take))
RELEASED_FOLDERS = released_setting(
    lambda settings: [folder for folder in (settings.folder, settings.photographs) if folder]
)
RELEASED_SETTINGS = released_setting(lambda settings: settings.plain())
