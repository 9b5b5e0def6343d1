"""Files and settings of captures (docs/capture.md). Needs scenes.smk."""

from functools import cache
from types import SimpleNamespace

from neuma_lib.project.capture_folder import NAME, inside, read_capture
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
    "duration",
    "frames",
    "width",
)
POSES_THREADS = 8  # for matching, or all available ones if fewer


# Names of folders with other results.
OTHERS = f"{TRUE_SCENE}|{SPLAT_SCENE}|figures|logs|benchmarks|experiments|priors"
RELEASED_CAPTURE = names_of(SETTINGS.captures.released, chains=False)
OWN_CAPTURE = f"(?!({OTHERS}|{RELEASED_CAPTURE})/){NAME.pattern}"
RELEASED_THROW = scenes_that(
    lambda scene: scene.captured and scene.captured.capture in SETTINGS.captures.released, chains=False
)
OWN_THROW = f"(?!{RELEASED_THROW}/){THROW_SCENE}"


wildcard_constraints:
    capture=f"(?!({OTHERS})/){NAME.pattern}",
    throw=NAME.pattern,
    camera=NAME.pattern,


@cache
def capture_named(name):
    if name in SETTINGS.captures.released:
        return released_captures({name: SETTINGS.captures.released[name]})[name]
    return PLANNED.get(name) or read_capture(f"{CAPTURES}/{name}")


def of_capture(choose):
    """A function of wildcards: a value of their capture."""
    return checked(lambda wildcards: choose(capture_named(wildcards.capture)))


def capture_photographs(capture):
    return list(map(str, capture.pictures()["photographs"]))


def capture_stills(capture):
    return list(map(str, capture.stills.values()))


def capture_file(capture, name):
    """A file in the capture's folder that the settings name."""
    return [str(inside(capture.folder, name))] if name else []


def given_poses(capture):
    poses = capture.settings.poses
    return capture_file(capture, None if poses in ("photographs", "board") else poses)


def filmed_by(capture):
    """Take and camera of all videos."""
    return [(take, camera) for take, cameras in capture.takes.items() for camera in cameras]


def of_videos(ending, stage="frames"):
    """A function of wildcards: a file for each video of their capture."""

    @checked
    def choose(wildcards):
        name = wildcards.capture
        videos = filmed_by(capture_named(name))
        return [f"{RESULTS}/{name}/{stage}/{take}/{camera}.{ending}" for take, camera in videos]

    return choose


@checked
def filmed_rate(wildcards):
    camera = capture_named(wildcards.capture).settings.cameras.get(wildcards.camera)
    return camera.rate if camera else None


def room_settings(capture):
    """Settings that the room depends on."""
    return capture.settings.model_dump(mode="json", exclude={*OF_VIDEOS, "photographs", "masks"})


def photograph_masks(capture):
    return list(map(str, capture.own_masks("photographs").values()))


@checked
def saliency_network(wildcards):
    """The network, if a photograph has no mask of the user."""
    capture = capture_named(wildcards.capture)
    own = capture.own_masks("photographs")
    return [] if all(p.stem in own for p in capture.photographs) else [f"{DATA}/weights/u2netp.onnx"]


@checked
def video_masks(wildcards):
    own = capture_named(wildcards.capture).own_masks(f"{wildcards.throw}/{wildcards.camera}")
    return list(map(str, own.values()))


@checked
def filmed_cameras(wildcards):
    """Cameras of a take. The first one is the time reference."""
    return capture_named(wildcards.capture).cameras_of(wildcards.throw)


def of_throw(pattern):
    """A function of wildcards: a file for each camera of their take."""

    @checked
    def choose(wildcards):
        cameras = capture_named(wildcards.capture).cameras_of(wildcards.throw)
        return [
            pattern.format(capture=wildcards.capture, throw=wildcards.throw, camera=camera)
            for camera in cameras
        ]

    return choose


def of_throws(pattern):
    """A function of wildcards: a file for each take of their capture."""

    @checked
    def choose(wildcards):
        name = wildcards.capture
        return [pattern.format(capture=name, throw=take) for take in capture_named(name).takes]

    return choose


@checked
def throw_videos(wildcards):
    capture = capture_named(wildcards.capture)
    return [str(capture.video(wildcards.throw, camera)) for camera in capture.cameras_of(wildcards.throw)]


@checked
def camera_timing(wildcards):
    """Offset and row time in the settings, for each camera of a take."""
    capture = capture_named(wildcards.capture)
    settings = [capture.settings.cameras.get(camera) for camera in capture.cameras_of(wildcards.throw)]
    return {
        "offsets": [camera.offset if camera else None for camera in settings],
        "row_times": [camera.row_time if camera else 0.0 for camera in settings],
    }


@checked
def camera_exposures(wildcards):
    """Exposure in the settings, for each camera of a take."""
    capture = capture_named(wildcards.capture)
    settings = [capture.settings.cameras.get(camera) for camera in capture.cameras_of(wildcards.throw)]
    return [camera.exposure if camera else 0.0 for camera in settings]


def of_thrown(function):
    """Convert a function of the wildcards capture and throw to a function of the scene of a take."""

    def choose(wildcards):
        captured = SETTINGS.scene(wildcards.scene).captured
        return function(SimpleNamespace(capture=captured.capture, throw=captured.throw))

    return choose


def of_filmed(pattern):
    """A function of the scene of a take: a file for each of its cameras."""
    return of_thrown(of_throw(pattern))


def of_thrown_capture(choose):
    """A function of the scene of a take: a value of its capture."""
    return of_thrown(of_capture(choose))


def released_settings(wildcards):
    return SETTINGS.captures.released[wildcards.capture].plain()


@checked
def released_folders(wildcards):
    settings = SETTINGS.captures.released[wildcards.capture]
    return [folder for folder in (settings.folder, settings.photographs) if folder]


@checked
def one_clock(wildcards):
    """Timing of cameras that share a clock."""
    zeros = [0.0] * len(filmed_cameras(wildcards))
    return {"offsets": zeros, "row_times": zeros}


def of_the_object(file):
    """A function of the scene of a take: a file of its photographed object."""
    return of_thrown(lambda wildcards: f"{RESULTS}/{wildcards.capture}/{file}")
