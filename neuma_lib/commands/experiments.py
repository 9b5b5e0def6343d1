"""Commands ``next`` and ``lab``."""

import argparse
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from neuma_lib.commands.parsing import CONFIGFILE, CORES, add_command, argument
from neuma_lib.errors import InputError


def add_commands(commands: Any) -> None:
    """Add the commands to a parser."""
    add_command(
        commands,
        _next,
        "next: rank what to film next to learn more about a material",
        "Ranks launches and second cameras by what they are expected to add to an identified material, and writes "
        "next.md, next.json and next.png to the folder. The section `next` of the settings has the limits of the lab. "
        "Example: neuma next results/ClayCat",
        argument("folder", metavar="FOLDER", help="folder of an identified scene, in results/"),
        CORES,
        CONFIGFILE,
    )
    count = "maximum number of experiments (default %(default)s)"
    add_command(
        commands,
        _lab,
        "lab: repeat the choice in a simulated lab until the material is known",
        "Chooses the best launch or camera, renders it, identifies all videos of the scene together, and repeats this "
        "until all constants are determined or nothing more can be learned. The choice does not read the true "
        "material. Writes lab.md and lab.json to the folder. Example: neuma lab results/ClayCat",
        argument("folder", metavar="FOLDER", help="folder of a rendered scene, in results/"),
        argument("--experiments", type=int, default=4, help=count),
        CORES,
        CONFIGFILE,
    )


def _identified_folder(options: argparse.Namespace) -> tuple[Path, list[Path], Any]:
    """Folder of a scene, its settings files, and a function that makes targets with settings files."""
    from neuma_lib.extras import require
    from neuma_lib.project.project import Project, remembered_settings

    folder = Path(options.folder).absolute()
    settings, root = Project.find(folder, options.configfile)
    settings.scene(folder.name)
    require("snakemake", "workflow")
    files = [Path(file).absolute() for file in options.configfile] or remembered_settings(folder, root)
    command = [sys.executable, "-m", "snakemake", f"--cores={options.cores}"]

    def make(files: Sequence[Path], target: str) -> int:
        given = ["--configfile", *map(str, files)] if files else []
        return subprocess.run([*command, *given, "--", target], cwd=root).returncode

    return folder, files, make


def _lab(options: argparse.Namespace) -> int:
    from neuma_lib.project.lab import run_lab

    folder, files, make = _identified_folder(options)
    complete = run_lab(folder, files, options.experiments, make, print)
    if complete:
        print(f"Experiments and constants: {folder / 'lab.md'}")
    return int(not complete)


def _next(options: argparse.Namespace) -> int:
    from neuma_lib.project.project import project_folder

    folder, files, make = _identified_folder(options)
    if not (folder / "identified.json").is_file():
        problem = "does not exist, so the material has not been identified"
        remedy = f"Run `snakemake --cores {options.cores} {options.folder}/identified.json` first"
        raise InputError(folder / "identified.json", problem, remedy)
    page = folder / "next.md"
    status = make(files, page.relative_to(project_folder(folder)).as_posix())
    if status == 0:
        print("\n".join(line for line in page.read_text().splitlines() if line[:2] in ("1.", "2.", "3.")))
        print(f"All candidates and pictures: {page}")
    return status
