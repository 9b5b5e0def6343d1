"""Commands ``demo``, ``new``, ``select``, ``check``, ``view``, ``clip`` and ``timings``."""

import argparse
import contextlib
import subprocess
import sys
from pathlib import Path
from typing import Any

from neuma_lib.commands.parsing import CONFIGFILES, CORES, add_command, add_group, argument
from neuma_lib.errors import InputError


def add_commands(commands: Any) -> None:
    """Add the commands to a parser."""
    add_command(
        commands,
        _demo,
        "demo: run a small example, from a rendered video to a learned material (minutes)",
        "Renders a video of a falling duck, learns its material, and writes a film, a table and a viewer page to "
        "results/demo. Takes a few minutes on two cores. Run it in the project's folder.",
        CORES,
    )
    new = add_group(commands, "new", "create the settings of a scene or a capture")
    mesh = "shape of the object, .obj, .ply, .stl or .glb with y up; copied to meshes/ if outside the project"
    chosen = "results of a scene with next.md: the scene of the experiment that it lists first, or --rank"
    add_command(
        new,
        _new_scene,
        "scene: create config/NAME.yaml with a scene to edit",
        "The scene runs unchanged and has comments on what to change. Prints the commands to run next.",
        argument("name", metavar="NAME", help="name of the scene and of its folder in results/"),
        argument("--mesh", metavar="FILE", help=mesh),
        argument("--from", dest="source", metavar="FOLDER", help=chosen),
        argument("--rank", type=int, default=1, help="rank of that experiment (default %(default)s)"),
    )
    add_command(
        new,
        _new_capture,
        "capture: create captures/NAME for your own photographs and videos",
        "Writes captures/NAME/capture.yaml and creates the folders of the files. Prints what to do next.",
        argument("name", metavar="NAME", help="name of the capture and of its folder in captures/"),
    )
    add_command(
        commands,
        _select,
        "select: mark the object of a capture in a photograph",
        "Writes select.html into the folder of a capture. Open it in a browser and click the object, or draw a box "
        "around it: the page shows the line for capture.yaml. Example: neuma select captures/mug",
        argument("folder", metavar="FOLDER", help="folder of a capture, such as captures/mug"),
    )
    files = f"{CONFIGFILES}; or a capture.yaml. None: config/config.yaml alone"
    add_command(
        commands,
        _check,
        "check: check settings without running anything",
        "Checks keys and values, laws and their constants, shapes, start positions and velocities, time steps, "
        "captures, and the GPU, in seconds. Prints each problem on a line and exits with status 1 if there is one. "
        "Also notes results that were made with other versions of Python, torch, warp, numpy, bpy or pycolmap.",
        argument("files", nargs="*", metavar="FILE", help=files),
    )
    device = "where the live mode simulates (default: a GPU if there is one)"
    add_command(
        commands,
        _view,
        "view: show a scene's motions in a browser",
        "Serves the motions of a scene to a browser, with a live mode that simulates its object under any learned law. "
        "Example: neuma view results/BouncyBall. With --file it writes one HTML page instead, without a server. For a "
        "capture's folder, it does what neuma select does.",
        argument("folder", metavar="FOLDER", help="folder of a scene, such as results/BouncyBall"),
        argument("--file", help="write one HTML file that needs no server, and exit"),
        argument("--host", default="127.0.0.1", help="address (default %(default)s, this machine)"),
        argument("--port", type=int, default=8080, help="port, or the next free one (default %(default)s)"),
        argument("--methods", nargs="+", metavar="METHOD", help="methods to show (default: all)"),
        argument("--configfile", dest="configfiles", nargs="+", default=(), metavar="FILE", help=CONFIGFILES),
        argument("--device", default="auto", choices=("auto", "cpu", "cuda"), help=device),
    )
    width = "width of the object across its longer axis [m]; without it, the width follows from gravity"
    add_command(
        commands,
        _clip,
        "clip: measure the flight of an object in one video",
        "Measures gravity, spin, rebound and shape, and the stiffness of a ball, in a video of a fixed camera, without "
        "photographs or calibration. Writes clip.md, clip.json and pictures. Example: neuma clip ball.mp4 results/ball "
        "--diameter 0.067",
        argument(
            "video", metavar="VIDEO", help="video of the flight, filmed from the side by a fixed camera"
        ),
        argument("folder", metavar="FOLDER", help="folder of the results"),
        argument("--diameter", type=float, metavar="METRES", help=width),
    )
    results = "folder of results (default %(default)s)"
    add_command(
        commands,
        _timings,
        "timings: print how long each stage took",
        "Prints a table of run times and memory of all stages, from the benchmark files below a folder of results.",
        argument("folder", nargs="?", default="results", metavar="FOLDER", help=results),
    )


def _demo(options: argparse.Namespace) -> int:
    from neuma_lib.extras import require
    from neuma_lib.project.project import project_folder

    root = project_folder(".")
    require("snakemake", "workflow")
    command = [sys.executable, "-m", "snakemake", f"--cores={options.cores}", "--configfile=config/demo.yaml"]
    subprocess.run([sys.executable, "-m", "workflow.unlock"], cwd=root, check=True)
    status = subprocess.run([*command, "--", "demo"], cwd=root).returncode
    if status == 0:
        page = root / "results/demo/SoftDuck/viewer.html"
        print(f"Open {page} in a browser. Film and numbers: results/demo/demo.md")
    return status


def _new_scene(options: argparse.Namespace) -> None:
    from neuma_lib.project.project import Project, remembered_settings
    from neuma_lib.project.scaffold import new_scene, next_scene

    if options.source:
        folder = Path(options.source).absolute()
        settings, root = Project.find(folder)
        file = next_scene(root, options.name, settings, folder, options.rank).relative_to(root)
        files = [*(path.relative_to(root) for path in remembered_settings(folder, root)), file]
        target = (folder / "identified.json").relative_to(root)
        print(f"Created {file}. To render it and identify both videos together, run in {root}:")
        print(f"  snakemake --cores 2 --configfile {' '.join(map(str, files))} -- {target}")
        return
    settings, root = Project.find(".")
    file, name = new_scene(root, options.name, settings, options.mesh).relative_to(root), options.name
    print(f"Created {file}. Edit it, then run in {root}:")
    print(f"  neuma check {file}")
    print(f"  snakemake --cores 2 --configfile {file} -- results/{name}/film.mp4 results/{name}/viewer.html")


def _new_capture(options: argparse.Namespace) -> None:
    from neuma_lib.project.project import Project
    from neuma_lib.project.scaffold import new_capture

    settings, root = Project.find(".")
    file = new_capture(root, options.name, settings).relative_to(root)
    folder = file.parent
    print(f"Created {file}. docs/capture.md explains how to photograph and film. Next:")
    print(f"  snakemake --cores 2 {settings.captures.root}/board.pdf   # print it and lay it on the floor")
    print(f"  copy your files to {folder}/photos, {folder}/stills and {folder}/videos")
    print(f"  neuma select {folder}   # if other objects are around: mark yours in a browser")
    print(f"  neuma check {file}")
    print(f"  snakemake --cores 2 results/{options.name}/capture.md")


def _select(options: argparse.Namespace) -> None:
    from neuma_lib.viewer.select import write_select_page

    print(f"Open {write_select_page(options.folder)} in a browser")


def _check(options: argparse.Namespace) -> int:
    from neuma_lib.project import checks
    from neuma_lib.project.project import Project, project_folder
    from neuma_lib.project.versions import changes

    captures = [file for file in options.files if Path(file).name == "capture.yaml"]
    files = [file for file in options.files if file not in captures]
    problems = checks.capture_problems([Path(file).parent for file in captures])
    text = f"{', '.join(captures)}: no problems"
    if files or not captures:
        root = project_folder(".")
        try:
            settings, _ = Project.find(root, files, lambda error: problems.extend(checks.lines(error)))
        except InputError as error:
            problems += checks.lines(error)
        else:
            with contextlib.chdir(root):  # paths of meshes are relative to it
                problems += checks.problems(settings) + checks.local_problems(settings)
            text = checks.summary(settings, ["config/config.yaml", *files])
            for change in changes(root / settings.results_root):
                print(f"note: {change}")
    print("\n".join(dict.fromkeys(problems)) or text)
    return 1 if problems else 0


def _view(options: argparse.Namespace) -> None:
    if not options.file and (Path(options.folder) / "capture.yaml").is_file():
        return _select(options)
    from neuma_lib.viewer.open import view

    view(**{key: value for key, value in vars(options).items() if key != "run"})


def _clip(options: argparse.Namespace) -> None:
    from neuma_lib.capture.clip import analyse_clip, checks

    if options.diameter is not None and not options.diameter > 0:
        raise InputError("--diameter", f"{options.diameter:g} must be above 0")
    for check in checks(analyse_clip(options.video, options.folder, options.diameter)):
        expected = f" (expected: {check.wanted})" if check.wanted else ""
        print(f"{check.what}: {check.value}{expected}")
    print(f"Report: {Path(options.folder) / 'clip.md'}")


def _timings(options: argparse.Namespace) -> None:
    from neuma_lib.project.timings import timings_table

    print(timings_table(Path(options.folder)), end="")
