"""The project that a folder of results belongs to, and its settings."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

from neuma_lib.errors import InputError
from neuma_lib.project.capture_scenes import captured_scenes
from neuma_lib.project.loading import load, load_captures, merged, read_yaml
from neuma_lib.project.settings import Config

SETTINGS_FILE = Path("config/config.yaml")
"""Settings of a project, below its folder."""


class Project(NamedTuple):
    """Settings of a project, as the workflow has them, and its folder."""

    settings: Config
    root: Path

    @classmethod
    def find(cls, place: str | Path, configfiles: Sequence[str | Path] = ()) -> Project:
        """The project that a folder lies in.

        Args:
            configfiles: settings on top of those of the project, in this order, as by Snakemake's ``--configfile``.

        Raises:
            InputError: no folder above it has settings, or these are not valid.
        """
        place = Path(place).absolute()
        root = next((up for up in (place, *place.parents) if (up / SETTINGS_FILE).is_file()), None)
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
        return cls(load(raw, root, captured=captured_scenes(root / captures.root, released)), root)
