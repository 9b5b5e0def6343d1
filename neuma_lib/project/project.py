"""The project that a folder of results belongs to, and its settings."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from neuma_lib.errors import InputError
from neuma_lib.project.capture_scenes import captured_scenes
from neuma_lib.project.loading import load, load_captures, merged, read_yaml
from neuma_lib.project.settings import Config

SETTINGS_FILE = Path("config/config.yaml")
"""Settings of a project, below its folder."""


def find_project(place: str | Path, configfiles: Sequence[str | Path] = ()) -> tuple[Config, Path]:
    """Settings of the project that a folder lies in, as the workflow has them, and the project's folder.

    Args:
        configfiles: settings laid over those of the project, in this order, as by Snakemake's ``--configfile``.

    Raises:
        InputError: no folder above it has settings, or these are not valid.
    """
    place = Path(place).absolute()
    root = next((folder for folder in (place, *place.parents) if (folder / SETTINGS_FILE).is_file()), None)
    if root is None:
        problem = f"neither it nor a folder above it has {SETTINGS_FILE}"
        raise InputError(place, problem, "Give a folder in a project's results")
    raw: dict[str, Any] = {}
    for file in (root / SETTINGS_FILE, *configfiles):
        raw = merged(raw, read_yaml(file))
    captures = load_captures(raw)
    released = {
        name: item.model_copy(update={"folder": str(root / item.folder)})
        for name, item in captures.released.items()
    }
    scenes = captured_scenes(root / captures.root, released)
    return load(raw, root, captured=scenes), root
