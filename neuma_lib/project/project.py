"""The project that a folder of results belongs to, and its settings."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from neuma_lib.errors import InputError
from neuma_lib.project.capture_scenes import captured_scenes
from neuma_lib.project.loading import load, load_captures, merged, read_yaml
from neuma_lib.project.settings import Config

SETTINGS_FILE = Path("config/config.yaml")
"""Settings of a project, below its folder."""


def project_folder(place: str | Path) -> Path:
    """The folder of the project that a folder lies in. Raises InputError if it lies in none."""
    place = Path(place).absolute()
    for folder in (place, *place.parents):
        if (folder / SETTINGS_FILE).is_file():
            return folder
    problem = f"is not in a project: neither it nor a folder above it has {SETTINGS_FILE}"
    raise InputError(place, problem, "Clone the repository and use a folder in it")


class Project(NamedTuple):
    """Settings of a project, as the workflow has them, and its folder."""

    settings: Config
    root: Path

    @classmethod
    def find(
        cls,
        place: str | Path,
        configfiles: Sequence[str | Path] = (),
        log: Callable[[InputError], None] = lambda error: None,
    ) -> Project:
        """The project that a folder lies in.

        Args:
            configfiles: settings on top of those of the project, in this order, as by Snakemake's ``--configfile``.
            log: called for each capture that has no scenes, as by `captured_scenes`.

        Raises:
            InputError: see `project_folder`, or the settings are not valid.
        """
        root = project_folder(place)
        raw: dict[str, Any] = {}
        for file in (root / SETTINGS_FILE, *configfiles):
            if not (content := read_yaml(file)):
                raise InputError(file, "the file is empty", "Write settings into it, or leave it out")
            raw = merged(raw, content)
        captures = load_captures(raw)
        released = {
            name: item.model_copy(update={"folder": str(root / item.folder)})
            for name, item in captures.released.items()
        }
        captured = captured_scenes(root / captures.root, released, log=log)
        return cls(load(raw, root, captured=captured), root)
