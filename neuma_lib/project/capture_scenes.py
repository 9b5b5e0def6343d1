"""Scenes of captures: the object at rest from its photographs, and each take."""

import logging
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import Any

from neuma_lib.config.capture import ReleasedConfig
from neuma_lib.config.validation import hint
from neuma_lib.config.variants import name_problem
from neuma_lib.errors import InputError
from neuma_lib.io.files import one_line
from neuma_lib.project.capture_folder import Capture, capture_folders, read_capture
from neuma_lib.project.released_captures import released_captures

_LOGGER = logging.getLogger(__name__)


def warn_of_missing_scenes(error: InputError) -> None:
    """Warn that a capture has no scenes."""
    _LOGGER.warning("a capture has no scenes: %s", error)


def captured_scenes(
    root: str | Path,
    released: Mapping[str, ReleasedConfig] | None = None,
    planned: Mapping[str, Capture] | None = None,
    log: Callable[[InputError], None] = warn_of_missing_scenes,
) -> dict[str, dict[str, Any]]:
    """Settings of the scenes of all captures in a folder, of released and of planned captures, by name.

    A capture ``mug`` has a scene ``mug`` for its photographs and a scene ``mug_<take>`` for each take. The law is
    learned in the first of the `training_takes`. The others are its ``videos``. Each of several bodies has a scene in
    addition, ``mug_<body>`` and ``mug_<take>_<body>``, by `neuma_lib.project.loading`.

    Args:
        log: called for each capture, released or in the folder, that has no scenes, because it cannot be read or they
            are those of another capture. Targets that need it are refused by its own rules. By default a warning.
    """
    scenes: dict[str, dict[str, Any]] = {}
    for capture in (planned or {}).values():
        scenes |= scenes_of(capture)
    readers = [partial(_released_capture, name, settings) for name, settings in (released or {}).items()]
    folders = [folder for folder in capture_folders(root) if folder.name not in (planned or {})]
    for read in [*readers, *(partial(checked_capture, folder) for folder in folders)]:
        try:
            capture = read()
            own = scenes_of(capture)
            if shared := sorted(own.keys() & scenes):
                problem = f"another capture has a scene {shared[0]}"
                raise InputError(capture.folder, problem, "Rename one of the two")
        except InputError as error:
            log(error)
        else:
            scenes |= own
    return scenes


def _released_capture(name: str, settings: ReleasedConfig) -> Capture:
    return released_captures({name: settings})[name]


def checked_capture(folder: Path) -> Capture:
    """A capture whose scenes can be used. Raises InputError for its name, or as `read_capture` and `training_takes`."""
    if problem := name_problem(folder.absolute().name):
        raise InputError(folder, problem, "Rename the folder")
    try:
        capture = read_capture(folder)
    except OSError as error:
        raise InputError(folder, one_line(error), "Make it readable, or move it elsewhere") from None
    training_takes(capture)
    return capture


def scenes_of(capture: Capture) -> dict[str, dict[str, Any]]:
    """Settings of the scenes of one capture, by name."""
    name, settings = capture.folder.name, capture.settings
    common: dict[str, Any] = {"prior": settings.prior, "dt": settings.dt}
    if settings.bodies:
        common["bodies"] = {key: {"density": body.density} for key, body in settings.bodies.items()}
    else:
        common["density"] = settings.density
    world = {"capture": name, "scale": settings.scale, "grid": settings.grid}
    scenes = {name: {**common, "captured": world}}
    trained = training_takes(capture)
    for take, cameras in capture.takes.items():
        scenes[scene_name(name, take)] = {
            **common,
            "captured": {**world, "throw": take, "cameras": list(cameras)},
            "training": {"views": list(range(len(cameras)))},
            "videos": (
                [scene_name(name, other) for other in trained[1:]]
                if take in trained[:1] and not settings.bodies
                else []
            ),
        }
    return scenes


def scene_name(capture: str, take: str) -> str:
    """Name of the scene of a take."""
    return f"{capture}_{take}"


def training_takes(capture: Capture) -> list[str]:
    """Takes that the law is learned from, by name. Raises InputError if ``held_out`` of the capture is invalid."""
    where = f"{capture.folder / 'capture.yaml'}: held_out"
    for take in capture.settings.held_out:
        if take not in capture.takes:
            raise InputError(where, f"no take '{take}'{hint(take, capture.takes)}")
    trained = sorted(set(capture.takes) - set(capture.settings.held_out))
    if capture.takes and not trained:
        raise InputError(where, "all takes are held out", "Keep at least one for training")
    for take in trained[1:]:
        if list(capture.takes[take]) != list(capture.takes[trained[0]]):
            problem = f"'{take}' and '{trained[0]}' have different cameras"
            raise InputError(where, problem, "Hold one of them out")
    return trained
