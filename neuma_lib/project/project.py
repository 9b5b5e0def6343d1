"""The project that a folder of results belongs to, and its settings."""

import os
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from neuma_lib.errors import InputError
from neuma_lib.io.files import existing, write_text
from neuma_lib.project.capture_scenes import captured_scenes, warn_of_missing_scenes
from neuma_lib.project.loading import load, load_captures, merged, read_yaml
from neuma_lib.project.settings import Config

SETTINGS_FILE = Path("config/config.yaml")  # settings of a project, below its folder
REMEMBERED = "configfiles.txt"  # record of the settings files of a scene's latest run, with its logs


def project_folder(place: str | Path) -> Path:
    """The folder of the project that a folder lies in. Raises InputError if it lies in none."""
    place = Path(place).absolute()
    for folder in (place, *place.parents):
        if (folder / SETTINGS_FILE).is_file():
            return folder
    problem = f"is not in a project: neither it nor a folder above it has {SETTINGS_FILE}"
    raise InputError(place, problem, "Clone the repository and use a folder in it")


def remember_settings(
    results: str | Path, scene: str, configfiles: Sequence[str | Path], root: str | Path
) -> None:
    """Record which settings files the latest run of a scene had on top of those of the project."""
    files = [os.path.relpath(file, root) for file in configfiles]
    lines = [f"{file}\n" for file in files if Path(file) != SETTINGS_FILE]
    write_text(Path(results, "logs", scene, REMEMBERED), "".join(lines))


def remembered_settings(place: str | Path, root: Path) -> list[Path]:
    """The settings files that the latest run of a scene had, given its folder of results or one below it.

    Raises:
        InputError: one of them no longer exists.
    """
    place = Path(place).absolute()
    for folder in (place, *place.parents):
        if folder == root or not folder.is_relative_to(root):
            break
        for results in (above for above in folder.parents if above.is_relative_to(root)):
            if (record := results / "logs" / folder.relative_to(results) / REMEMBERED).is_file():
                names = record.read_text(errors="replace").splitlines()
                return [existing(root / name, "Give the settings by --configfile") for name in names]
    return []


class Project(NamedTuple):
    """Settings of a project, as the workflow has them, and its folder."""

    settings: Config
    root: Path

    @classmethod
    def find(
        cls,
        place: str | Path,
        configfiles: Sequence[str | Path] = (),
        log: Callable[[InputError], None] = warn_of_missing_scenes,
    ) -> "Project":
        """The project that a folder lies in.

        Args:
            configfiles: settings on top of those of the project, in this order, as by Snakemake's ``--configfile``. If
                there are none, those of the latest run of the folder (`remembered_settings`).
            log: called for each capture that has no scenes, as by `captured_scenes`.

        Raises:
            InputError: see `project_folder`, or the settings are not valid.
        """
        root = project_folder(place)
        raw: dict[str, Any] = {}
        configfiles = configfiles or remembered_settings(place, root)
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
