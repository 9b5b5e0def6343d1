"""The command ``neuma``, also ``python -m neuma_lib``. Each subcommand loads what it needs when it runs."""

from __future__ import annotations

import argparse
import contextlib
import json
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from neuma_lib import __version__
from neuma_lib.errors import InputError, NonFiniteError

if TYPE_CHECKING:
    from neuma_lib.mechanics.law import Law

CONFIGFILE = "settings on top of config/config.yaml, as for snakemake"
PAGE = "also draw the law's stress curves, .png or .pdf"


def main(words: Sequence[str] | None = None) -> int:
    """Run a command.

    Args:
        words: its arguments; None: those of the process.

    Returns:
        exit status: 0, or 1 after an error that the user can correct, which is printed.
    """
    options = _parser().parse_args(words)
    try:
        return options.run(options) or 0
    except (InputError, NonFiniteError) as error:
        print(f"ERROR: {error}", file=sys.stderr)
        return 1


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="neuma",
        description="Learn the material of a deformable object from video. `neuma COMMAND --help` explains a command.",
    )
    parser.add_argument("--version", action="version", version=f"neuma {__version__}")
    commands = parser.add_subparsers(required=True, metavar="COMMAND")

    demo = _command(
        commands,
        _demo,
        "demo: run a small example, from a rendered video to a learned material (minutes)",
        "Renders a video of a falling duck, learns its material, and writes a film, a table and a viewer page to "
        "results/demo. Takes a few minutes on two cores. Run it in the project's folder.",
    )
    _add_cores(demo)

    new = _group(commands, "new", "create the settings of a scene or a capture")
    scene = _command(
        new,
        _new_scene,
        "scene: create config/NAME.yaml with a scene to edit",
        "The scene runs unchanged and has comments on what to change. Prints the commands to run next.",
    )
    scene.add_argument("name", metavar="NAME", help="name of the scene and of its folder in results/")
    mesh = "shape of the object, .obj, .ply, .stl or .glb with y up; copied to meshes/ if outside the project"
    scene.add_argument("--mesh", metavar="FILE", help=mesh)
    chosen = "results of a scene with next.md: the scene of the experiment that it lists first, or --rank"
    scene.add_argument("--from", dest="source", metavar="FOLDER", help=chosen)
    scene.add_argument("--rank", type=int, default=1, help="rank of that experiment (default %(default)s)")
    capture = _command(
        new,
        _new_capture,
        "capture: create captures/NAME for your own photographs and videos",
        "Writes captures/NAME/capture.yaml and creates the folders of the files. Prints what to do next.",
    )
    capture.add_argument("name", metavar="NAME", help="name of the capture and of its folder in captures/")

    select = _command(
        commands,
        _select,
        "select: mark the object of a capture in a photograph",
        "Writes select.html into the folder of a capture. Open it in a browser and click the object, or draw a box "
        "around it: the page shows the line for capture.yaml. Example: neuma select captures/mug",
    )
    select.add_argument("folder", metavar="FOLDER", help="folder of a capture, such as captures/mug")

    check = _command(
        commands,
        _check,
        "check: check settings without running anything",
        "Checks keys and values, laws and their constants, shapes, start positions and velocities, time steps, "
        "captures, and the GPU, in seconds. Prints each problem on a line and exits with status 1 if there is one. "
        "Also notes results that were made with other versions of Python, torch, warp, numpy, bpy or pycolmap.",
    )
    files = f"{CONFIGFILE}; or a capture.yaml. None: config/config.yaml alone"
    check.add_argument("files", nargs="*", metavar="FILE", help=files)

    following = _command(
        commands,
        _next,
        "next: rank what to film next to learn more about a material",
        "Ranks launches and second cameras by what they are expected to add to an identified material, and writes "
        "next.md, next.json and next.png to the folder. The section `next` of the settings has the limits of the lab. "
        "Example: neuma next results/ClayCat",
    )
    following.add_argument("folder", metavar="FOLDER", help="folder of an identified scene, in results/")
    _add_cores(following)
    _add_configfile(following)

    lab = _command(
        commands,
        _lab,
        "lab: repeat the choice in a simulated lab until the material is known",
        "Chooses the best launch or camera, renders it, identifies all videos of the scene together, and repeats this "
        "until all constants are determined or nothing more can be learned. The choice does not read the true "
        "material. Writes lab.md and lab.json to the folder. Example: neuma lab results/ClayCat",
    )
    lab.add_argument("folder", metavar="FOLDER", help="folder of a rendered scene, in results/")
    lab.add_argument(
        "--experiments", type=int, default=4, help="maximum number of experiments (default %(default)s)"
    )
    _add_cores(lab)
    _add_configfile(lab)

    law = _group(commands, "law", "export a learned material to one file, or show such a file")
    export = _command(
        law,
        _export,
        "export: write a learned law to one file",
        "Writes a learned law to one .safetensors file, with its time step, origin and the range of deformations that "
        "it was learned from, and a model card, .md, next to it. Example: neuma law export results/RubberPawn/neuma "
        "law.safetensors --page law.png",
    )
    export.add_argument("source", metavar="SOURCE", help="folder of a method, or file of a law")
    export.add_argument("target", metavar="TARGET", help="file to write, .safetensors")
    export.add_argument("--page", metavar="FILE", help=PAGE)
    export.add_argument(
        "--separate",
        "--apart",
        dest="separate_adaptor",
        action="store_true",
        help="keep prior and adaptor separate, so that the adaptor's weight can be changed later",
    )
    weight = "weight of the adaptor when it is merged (default %(default)g)"
    export.add_argument("--weight", type=float, default=1.0, help=weight)
    steps = "allow time steps other than the one that it was learned with"
    export.add_argument("--any-step", dest="any_time_step", action="store_true", help=steps)
    _add_configfile(export)
    adaptor = "if SOURCE is the file of a prior: adaptor, ours or a released *_lora.pt"
    export.add_argument("--adaptor", metavar="FILE", help=adaptor)
    export.add_argument("--alpha", type=float, help="scale of a released adaptor (default 16)")
    export.add_argument(
        "--dt", type=float, help="if SOURCE is a file: time step that it was learned with [s]"
    )
    engine = "write a material of this engine instead: .json, newton and usd also .usda, mujoco also .xml"
    export.add_argument("--engine", metavar="NAME", help=f"{engine} (genesis, newton, mujoco, usd)")
    _add_material_options(export)
    export.add_argument("--density", type=float, help="density [kg/m^3] (default: that of its scene)")
    export.add_argument(
        "--substep", type=float, help="time step of the engine [s] (default: that of the law)"
    )
    world = "convert a law of a scaled simulator to metres of the filmed world"
    export.add_argument("--world", action="store_true", help=world)
    importer = _command(
        law,
        _import,
        "import: read the material of another engine as a law",
        "Reads a Genesis class with arguments (.json), a newton material (.usda) or a MuJoCo flex (.xml). "
        "Example: neuma law import gel.xml gel.safetensors",
    )
    importer.add_argument("source", metavar="SOURCE", help="file with the material, .json, .usda or .xml")
    importer.add_argument("target", metavar="TARGET", help="file to write, .safetensors")
    importer.add_argument(
        "--substep", type=float, help="time step of the engine [s], for a viscous Genesis liquid"
    )
    show = _command(
        law,
        _show,
        "show: print what an exported file states about its law",
        "Prints the metadata of a file that `neuma law export` wrote.",
    )
    show.add_argument("law", metavar="FILE", help="file written by `neuma law export`")
    show.add_argument("--page", metavar="FILE", help=PAGE)

    dataset = _command(
        commands,
        _dataset,
        "dataset: write scenes for other systems",
        "Writes images, masks and cameras of scenes in the layout that another system reads, and their true motions "
        "to a separate folder, truth. The scenes must have been rendered: snakemake --cores 2 dataset. "
        "docs/benchmark.md describes the files.",
    )
    dataset.add_argument(
        "--layout", required=True, choices=("neuma", "pac_nerf", "spring_gaus"), help="of the files"
    )
    dataset.add_argument("--out", required=True, metavar="DIR", help="folder to write")
    scenes = "scenes to write (default: those of table1 and the random scenes)"
    dataset.add_argument("scenes", nargs="*", metavar="SCENE", help=scenes)
    _add_configfile(dataset)
    score = _command(
        commands,
        _score,
        "score: score positions that any method predicted",
        "Prints the errors of predicted positions by the measures of the tables, and their place in a table. Example: "
        "neuma score mine.npz --truth benchmark/truth/BouncyBall.h5",
    )
    positions = (
        "one .h5 or .npz with an array x (T, N, 3) in metres, or .ply files, one per frame, or their folder"
    )
    score.add_argument("files", nargs="+", metavar="FILE", help=positions)
    truth = "true motion: truth/SCENE.h5 of `neuma dataset`, or data/SCENE/truth.h5"
    score.add_argument("--truth", required=True, metavar="FILE", help=truth)
    table = "table to compare with, .csv (default: the first in docs/results that has the scene, if any)"
    score.add_argument("--table", metavar="FILE", help=table)

    view = _command(
        commands,
        _view,
        "view: show a scene's motions in a browser",
        "Serves the motions of a scene to a browser, with a live mode that simulates its object under any learned law. "
        "Example: neuma view results/BouncyBall. With --file it writes one HTML page instead, without a server.",
    )
    view.add_argument("folder", metavar="FOLDER", help="folder of a scene, such as results/BouncyBall")
    view.add_argument("--file", help="write one HTML file that needs no server, and exit")
    view.add_argument("--host", default="127.0.0.1", help="address (default %(default)s, this machine)")
    port = "port, or the next free one (default %(default)s)"
    view.add_argument("--port", type=int, default=8080, help=port)
    view.add_argument("--methods", nargs="+", metavar="METHOD", help="methods to show (default: all)")
    view.add_argument(
        "--configfile", dest="configfiles", nargs="+", default=(), metavar="FILE", help=CONFIGFILE
    )
    device = "where the live mode simulates (default: a GPU if there is one)"
    view.add_argument("--device", default="auto", choices=("auto", "cpu", "cuda"), help=device)

    scene = _group(commands, "scene", "export a scene to another engine")
    scene_export = _command(
        scene,
        _scene_export,
        "export: write body, law, start and floor as a scene of Genesis, newton or MuJoCo",
        "Writes a folder with the scene and run.py, which plays it in the engine without this library. "
        "Example: neuma scene export results/BouncyBall/constants ball_in_newton --engine newton",
    )
    scene_export.add_argument("source", metavar="SOURCE", help="folder of a method in results/")
    scene_export.add_argument("target", metavar="TARGET", help="folder to write")
    scene_export.add_argument("--engine", required=True, metavar="NAME", help="genesis, newton or mujoco")
    _add_material_options(scene_export)
    _add_configfile(scene_export)

    clip = _command(
        commands,
        _clip,
        "clip: measure the flight of an object in one video",
        "Measures gravity, spin and rebound in a video of a fixed camera, without photographs or calibration. Writes "
        "clip.md, clip.json and pictures. Example: neuma clip ball.mp4 results/ball --diameter 0.067",
    )
    clip.add_argument(
        "video", metavar="VIDEO", help="video of the flight, filmed from the side by a fixed camera"
    )
    clip.add_argument("folder", metavar="FOLDER", help="folder of the results")
    width = "width of the object across its longer axis [m]; without it, the width follows from gravity"
    clip.add_argument("--diameter", type=float, metavar="METRES", help=width)

    timings = _command(
        commands,
        _timings,
        "timings: print how long each stage took",
        "Prints a table of run times and memory of all stages, from the benchmark files below a folder of results.",
    )
    results = "folder of results (default %(default)s)"
    timings.add_argument("folder", nargs="?", default="results", metavar="FOLDER", help=results)
    return parser


def _add_material_options(parser: argparse.ArgumentParser) -> None:
    fit = "fit the nearest law that the engine has, over the states that the law has visited"
    parser.add_argument("--fit", action="store_true", help=fit)
    parser.add_argument("--force", action="store_true", help="accept a fit with a large stress error")


def _add_cores(command: argparse.ArgumentParser) -> None:
    command.add_argument("--cores", type=int, default=2, help="CPU cores to use (default %(default)s)")


def _add_configfile(command: argparse.ArgumentParser) -> None:
    command.add_argument("--configfile", nargs="+", default=[], metavar="FILE", help=CONFIGFILE)


def _command(commands: Any, run: Any, summary: str, description: str) -> argparse.ArgumentParser:
    """Add a command. The summary begins with its name and a colon."""
    name, _, text = summary.partition(": ")
    parser = commands.add_parser(name, help=text, description=description)
    parser.set_defaults(run=run)
    return parser


def _group(commands: Any, name: str, summary: str) -> Any:
    parser = commands.add_parser(name, help=summary, description=f"{summary.capitalize()}.")
    return parser.add_subparsers(required=True, metavar="COMMAND")


# ---- demo, new, check, timings ---------------------------------------------------------------------------------------


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
    print(f"  neuma check {file}")
    print(f"  snakemake --cores 2 results/{options.name}/capture.md")


def _select(options: argparse.Namespace) -> None:
    from neuma_lib.viewer.select import write_select_page

    print(f"Open {write_select_page(options.folder)} in a browser")


def _clip(options: argparse.Namespace) -> None:
    from neuma_lib.capture.clip import analyse_clip, checks

    if options.diameter is not None and not options.diameter > 0:
        raise InputError("--diameter", f"{options.diameter:g} must be above 0")
    for check in checks(analyse_clip(options.video, options.folder, options.diameter)):
        expected = f" (expected: {check.wanted})" if check.wanted else ""
        print(f"{check.what}: {check.value}{expected}")
    print(f"Report: {Path(options.folder) / 'clip.md'}")


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


def _timings(options: argparse.Namespace) -> None:
    from neuma_lib.project.timings import timings_table

    print(timings_table(Path(options.folder)), end="")


# ---- law -------------------------------------------------------------------------------------------------------------


def _export(options: argparse.Namespace) -> None:
    from neuma_lib.evaluation.law_export import export_law
    from neuma_lib.mechanics.adaptor import AdaptableLaw

    source = Path(options.source)
    law, known = _of_method(options) if source.is_dir() else _of_file(options)
    if options.engine is not None:
        _export_to_engine(options, law, known)
        return
    if options.fit or options.density is not None:
        raise InputError("--engine", "is missing", "Name the engine, or leave out --fit and --density")
    if options.weight != 1.0:
        if options.separate_adaptor:
            raise InputError("--weight", "a separate adaptor has no fixed weight", "Leave out --separate")
        if not isinstance(law, AdaptableLaw):
            raise InputError("--weight", f"{source} is an analytic law without an adaptor")
        law.set_adaptor_weight(options.weight)
        known["weight"] = options.weight
    about = export_law(
        options.target, law, separate_adaptor=options.separate_adaptor, page=options.page, **known
    )
    step = "" if about["dt"] is None else f", learned at dt = {about['dt']:g} s"
    print(f"{options.target}: {about['kind']}{step}" + (f"; {options.page}" if options.page else ""))


def _export_to_engine(options: argparse.Namespace, law: Law, known: dict[str, Any]) -> None:
    from neuma_lib.export.laws import law_for_engine
    from neuma_lib.export.materials import ENGINES, check_engine
    from neuma_lib.export.scenes import write_law_scene

    check_engine(options.engine, (*ENGINES, "usd"))
    engine = "newton" if options.engine == "usd" else options.engine
    if options.engine == "usd" and Path(options.target).suffix != ".usda":
        raise InputError(options.target, "the suffix is not .usda", "Give the file that suffix")
    if options.weight != 1.0 or options.page or options.separate_adaptor:
        raise InputError("--engine", "has no --weight, --page or --separate", "Leave them out")
    own = {name: getattr(options, name) for name in ("density", "substep", "fit", "force", "world")}
    material, about = law_for_engine(law, known, engine, states=_visited_states(known), **own)
    _print_material(options.target, material, write_law_scene(options.target, engine, material, about))


def _print_material(target: str, material: Any, notes: list[str]) -> None:
    arguments = ", ".join(
        f"{key} = {value if isinstance(value, (str, bool)) else format(value, '.4g')}"
        for key, value in material.arguments.items()
    )
    print(f"{target}: {material.kind}, {arguments}")
    for note in notes:
        print(f"note: {note}")


def _visited_states(known: dict[str, Any], count: int = 4000) -> Any:
    """Elastic states (N, 3, 3) of the motion of a method's folder, None without one."""
    if "rollout" not in known:
        return None
    import torch

    from neuma_lib.evaluation.stress import deformed_frames
    from neuma_lib.io.hdf5 import read_arrays

    F = torch.from_numpy(read_arrays(known["rollout"], required=("F",), only=("F",))[0]["F"])
    F = F[deformed_frames(F)].reshape(-1, 3, 3)
    return F[:: max(1, len(F) // count)] if len(F) else None


def _import(options: argparse.Namespace) -> None:
    from neuma_lib.export.laws import import_law

    spec = import_law(options.source, options.target, substep=options.substep)
    print(f"{options.target}: {json.dumps(spec)}")


def _scene_export(options: argparse.Namespace) -> None:
    from neuma_lib.api import Scene
    from neuma_lib.export.laws import law_for_engine
    from neuma_lib.export.scenes import EngineScene, export_scene

    if not Path(options.source).is_dir():
        raise InputError(
            options.source, "is not a folder", "Give that of a method, for example results/Ball/neuma"
        )
    for name in ("adaptor", "dt", "any_time_step"):
        setattr(options, name, None)
    law, known = _of_method(options)
    scene = Scene.load(Path(options.source).absolute().parent)
    frames = scene.video.frames if scene.video else scene.truth.frames if scene.truth else (0, 400)
    every = min(b - a for a, b in zip(frames[:-1], frames[1:], strict=True))
    own = EngineScene.of(scene.mpm, scene.state(), frames[-1], every, scene.reconstruction.gaussians)
    scale, known["scale"] = known.get("scale"), None  # the whole scene keeps the scale of the simulator
    material, about = law_for_engine(
        law, known, options.engine, density=own.density, substep=own.dt, fit=options.fit, force=options.force,
        states=_visited_states(known),
    )  # fmt: skip
    notes = export_scene(options.target, options.engine, own, about["law"], {**about, "scale": scale or 1.0})
    _print_material(options.target, material, notes)
    print(f"Play it with: python {options.target}/run.py")


def _of_method(options: argparse.Namespace) -> tuple[Law, dict[str, Any]]:
    """The law of a method's folder, and what `export_law` needs to know of it."""
    from neuma_lib.evaluation.law_export import head_commit
    from neuma_lib.project import cases
    from neuma_lib.project.project import Project

    if options.adaptor or options.dt is not None:
        raise InputError(
            options.source,
            "it is a method's folder, whose adaptor and time step are known",
            "Leave out --adaptor and --dt",
        )
    place = Path(options.source).absolute()
    settings, root = Project.find(place, options.configfile)
    settings = settings.model_copy(update={"results_root": str(place.parent.parent)})
    scene, method = place.parent.name, place.name
    case = cases.case(settings, scene, method)
    if not case.method.has_law:
        raise InputError(options.source, "its motion follows from no material law", "Choose another method")
    model = case.source().load(lambda file: str(root / file))
    law, origin = model.exported, cases.law_origin(settings, scene, method)
    if law is not model.law:
        origin["grid"] = None
    files = {"metrics": place / "metrics.json", "rollout": place / "rollout.h5"}
    of_this = {name: file for name, file in files.items() if file.is_file() and origin["scene"] == scene}
    origin["constants"] = model.constants
    return law, {**origin, **of_this, "any_time_step": options.any_time_step, "commit": head_commit(root)}


def _of_file(options: argparse.Namespace) -> tuple[Law, dict[str, Any]]:
    """The same of a file, with what an exported one already states."""
    from neuma_lib.io.exported import EXPORT, check_step, checked_export
    from neuma_lib.io.files import existing
    from neuma_lib.io.laws import RELEASED_ALPHA, load_law
    from neuma_lib.io.weights import read_weights

    source = existing(options.source, "name a method's folder in results/, or the file of a law")
    stated: dict[str, Any] = {}
    if source.suffix == ".safetensors":
        _, metadata = read_weights(source)
        stated = checked_export(metadata) if EXPORT in metadata else {}
    check_step("--dt", options.dt)
    dt = stated.get("dt") if options.dt is None else options.dt
    alpha = RELEASED_ALPHA if options.alpha is None else options.alpha
    law = load_law(source, options.adaptor, dt, options.any_time_step, alpha)
    of_the_law = ("grid", "gravity", "density", "scale")
    if not options.adaptor:
        of_the_law += ("scene", "method", "prior", "weight", "commit", "metrics", "visited", "constants")
    kept = {key: stated[key] for key in of_the_law if key in stated}
    kept |= {"prior": source.name} if options.adaptor else {}
    any_time_step = options.any_time_step or stated.get("any_step") is True
    return law, {**kept, "dt": stated.get("dt") or dt, "any_time_step": any_time_step}


def _show(options: argparse.Namespace) -> None:
    from neuma_lib.evaluation.law_export import show_law

    print(json.dumps(show_law(options.law, options.page), indent=1))


# ---- dataset, score --------------------------------------------------------------------------------------------------


def _dataset(options: argparse.Namespace) -> None:
    from neuma_lib.config.validation import hint
    from neuma_lib.io.datasets.benchmark import write_scene
    from neuma_lib.project.project import Project

    settings, root = Project.find(".", options.configfile)
    names = [name for name, scene in settings.scenes.items() if scene.has_truth]
    for name in (scenes := options.scenes or [*settings.tables["table1"].scenes, *settings.random_scenes]):
        if name not in names:
            raise InputError(name, f"no scene with a true motion has this name{hint(name, names)}")
    data, needed = Path(settings.data_root), ("truth.h5", "static/transforms.json", "dynamic/transforms.json")
    files = [str(data / name / file) for name in scenes for file in needed]
    missing = [file for file in files if not (root / file).is_file()]
    if missing:
        problem = f"{len(missing)} files of the scenes do not exist"
        raise InputError(missing[0], problem, f"Run `snakemake --cores 2 {' '.join(missing)}`")
    for name in scenes:
        scene = settings.scene(name).plain()
        known = {"dt": scene["dt"], "density": scene["density"]}
        about = {**known, **settings.scene_world(name), **settings.obstacles(name)}
        write_scene(options.layout, root / data / name, options.out, name, about)
    print(f"{options.out}: {len(scenes)} scenes. Keep {options.out}/truth from the methods that are scored.")


def _score(options: argparse.Namespace) -> None:
    import torch

    from neuma_lib.evaluation.scoring import score_positions
    from neuma_lib.io.hdf5 import read_arrays
    from neuma_lib.io.positions import read_positions
    from neuma_lib.paper import ranking

    names = ("tracers", "tracers_again", "frames")
    truth, about = read_arrays(options.truth, required=names, only=names)
    scene = about.get("scene", Path(options.truth).absolute().parent.name)
    x, frames = read_positions(options.files)
    try:
        sets = (torch.from_numpy(each) for each in (x, truth["tracers"], truth["tracers_again"]))
        metrics = score_positions(*sets, frames, truth["frames"])
    except InputError as error:
        raise InputError(options.files[0], error.problem, error.remedy) from None
    table = options.table or ranking.find_table("docs/results", scene)
    places = ranking.places(metrics, ranking.recorded(table, scene)) if table else {}
    if options.table and not places:
        raise InputError(
            table, f"has no methods in the scene {scene}", "Choose another --table, or leave it out"
        )
    print(
        f"{scene}: {len(x)} frames, {metrics.pop('points')} points"
        + (f", compared with {table}" if table else "")
    )
    for name, value in metrics.items():
        unit = "mm" if name.endswith("_mm") else "1e-4 m^2"
        print(f"  {name.removesuffix('_mm'):18} {value:9.4f} {unit:9} {places.get(name, '')}".rstrip())


# ---- view ------------------------------------------------------------------------------------------------------------


def _view(options: argparse.Namespace) -> None:
    from neuma_lib.viewer.open import view

    view(**{key: value for key, value in vars(options).items() if key != "run"})


if __name__ == "__main__":
    sys.exit(main())
