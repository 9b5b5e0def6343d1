"""Captures as scenes: the object as photographed, and each throw of it."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from neuma_lib.capture.folder import NAME, Capture, read_capture
from neuma_lib.config.capture import ReleasedConfig
from neuma_lib.config.validation import hint
from neuma_lib.errors import InputError


def captured_scenes(
    root: str | Path,
    released: Mapping[str, ReleasedConfig] | None = None,
    planned: Mapping[str, Capture] | None = None,
) -> dict[str, dict[str, Any]]:
    """Settings of the scenes of all captures in a folder, of released ones, and of those planned there, by name.

    A capture ``mug`` is the scene ``mug``, what the photographs show, and a scene ``mug_<throw>`` for each throw. The
    law is that of the first throw by name that is not held out (`training_throws`), whose ``videos`` are the others of
    these. A capture that cannot be read has none here: its own rules say why.
    """
    found: dict[str, dict[str, Any]] = {}
    for capture in (planned or {}).values():
        found |= scenes_of(capture)
    if released:
        # What reads them needs far more than every start of the workflow should load.
        from neuma_lib.capture.released import released_captures

        for capture in released_captures(released).values():
            found |= scenes_of(capture)
    folders = sorted(p for p in Path(root).iterdir() if p.is_dir()) if Path(root).is_dir() else []
    for folder in folders:
        if not NAME.fullmatch(folder.name) or folder.name in (planned or {}):
            continue
        try:
            capture = read_capture(folder)
            training_throws(capture)
        except InputError:
            continue
        found |= scenes_of(capture)
    return found


def scenes_of(capture: Capture) -> dict[str, dict[str, Any]]:
    """Settings of the scenes of one capture, by name."""
    name, settings = capture.folder.name, capture.settings
    common = {"prior": settings.prior, "density": settings.density, "dt": settings.dt}
    world = {"capture": name, "scale": settings.scale, "grid": settings.grid}
    scenes = {name: {**common, "captured": world}}
    trained = training_throws(capture)
    for throw, cameras in capture.throws.items():
        scenes[scene_name(name, throw)] = {
            **common,
            "captured": {**world, "throw": throw, "cameras": list(cameras)},
            "material": {"views": list(range(len(cameras)))},
            "videos": [scene_name(name, other) for other in trained[1:]] if throw in trained[:1] else [],
        }
    return scenes


def scene_name(capture: str, throw: str) -> str:
    """Name of the scene of a throw."""
    return f"{capture}_{throw}"


def training_throws(capture: Capture) -> list[str]:
    """Throws that the law is learned from, by name.

    Raises:
        InputError: a throw is held out that is not there, or all are; cameras differ between throws that are learned
            from together.
    """
    source = capture.folder / "capture.yaml"
    for throw in capture.settings.held_out:
        if throw not in capture.throws:
            raise InputError(f"{source}: held_out: there is no throw '{throw}'{hint(throw, capture.throws)}")
    trained = sorted(set(capture.throws) - set(capture.settings.held_out))
    if capture.throws and not trained:
        raise InputError(f"{source}: held_out: all throws are, nothing is left to learn from")
    for throw in trained[1:]:
        if list(capture.throws[throw]) != list(capture.throws[trained[0]]):
            raise InputError(
                f"{source}: '{throw}' and '{trained[0]}' were filmed by different cameras: hold one of them out"
            )
    return trained
