"""Commands ``law`` and ``scene``: laws and scenes for others."""

import argparse
import json
from pathlib import Path
from typing import TYPE_CHECKING, Any

from neuma_lib.commands.parsing import CONFIGFILE, add_command, add_group, argument
from neuma_lib.errors import InputError

if TYPE_CHECKING:
    from neuma_lib.mechanics.law import Law

PAGE = argument("--page", metavar="FILE", help="also draw the law's stress curves, .png or .pdf")
FIT = (
    argument(
        "--fit",
        action="store_true",
        help="fit the nearest law that the engine has, over the states that the law has visited",
    ),
    argument("--force", action="store_true", help="accept a fit with a large stress error"),
)


def add_commands(commands: Any) -> None:
    """Add the commands to a parser."""
    law = add_group(commands, "law", "export a learned material to one file, or show such a file")
    separate = "keep prior and adaptor separate, so that the adaptor's weight can be changed later"
    steps = "allow time steps other than the one that it was learned with"
    adaptor = "if SOURCE is the file of a prior: adaptor, ours or a released *_lora.pt"
    engine = "write a material of this engine instead: .json, newton and usd also .usda, mujoco also .xml"
    world = "convert a law of a scaled simulator to metres of the filmed world"
    add_command(
        law,
        _export,
        "export: write a learned law to one file",
        "Writes a learned law to one .safetensors file, with its time step, origin and the range of deformations that "
        "it was learned from, and a model card, .md, next to it. Example: neuma law export results/RubberPawn/neuma "
        "law.safetensors --page law.png",
        argument("source", metavar="SOURCE", help="folder of a method, or file of a law"),
        argument("target", metavar="TARGET", help="file to write, .safetensors"),
        PAGE,
        argument("--separate", "--apart", dest="separate_adaptor", action="store_true", help=separate),
        argument(
            "--weight",
            type=float,
            default=1.0,
            help="weight of the adaptor when it is merged (default %(default)g)",
        ),
        argument("--any-step", dest="any_time_step", action="store_true", help=steps),
        CONFIGFILE,
        argument("--adaptor", metavar="FILE", help=adaptor),
        argument("--alpha", type=float, help="scale of a released adaptor (default 16)"),
        argument("--dt", type=float, help="if SOURCE is a file: time step that it was learned with [s]"),
        argument("--engine", metavar="NAME", help=f"{engine} (genesis, newton, mujoco, usd)"),
        *FIT,
        argument("--density", type=float, help="density [kg/m^3] (default: that of its scene)"),
        argument("--substep", type=float, help="time step of the engine [s] (default: that of the law)"),
        argument("--world", action="store_true", help=world),
    )
    substep = "time step of the engine [s], for a viscous Genesis liquid"
    add_command(
        law,
        _import,
        "import: read the material of another engine as a law",
        "Reads a Genesis class with arguments (.json), a newton material (.usda) or a MuJoCo flex (.xml). "
        "Example: neuma law import gel.xml gel.safetensors",
        argument("source", metavar="SOURCE", help="file with the material, .json, .usda or .xml"),
        argument("target", metavar="TARGET", help="file to write, .safetensors"),
        argument("--substep", type=float, help=substep),
    )
    add_command(
        law,
        _show,
        "show: print what an exported file states about its law",
        "Prints the metadata of a file that `neuma law export` wrote.",
        argument("law", metavar="FILE", help="file written by `neuma law export`"),
        PAGE,
    )
    scene = add_group(commands, "scene", "export a scene to another engine")
    add_command(
        scene,
        _scene_export,
        "export: write body, law, start and floor as a scene of Genesis, newton or MuJoCo",
        "Writes a folder with the scene and run.py, which plays it in the engine without this library. "
        "Example: neuma scene export results/BouncyBall/constants ball_in_newton --engine newton",
        argument("source", metavar="SOURCE", help="folder of a method in results/"),
        argument("target", metavar="TARGET", help="folder to write"),
        argument("--engine", required=True, metavar="NAME", help="genesis, newton or mujoco"),
        *FIT,
        CONFIGFILE,
    )


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


def _export_to_engine(options: argparse.Namespace, law: "Law", known: dict[str, Any]) -> None:
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


def _visited_states(known: dict[str, Any]) -> Any:
    """Elastic states (N, 3, 3) of the motion of a method's folder, None without one."""
    if "rollout" not in known:
        return None
    import torch

    from neuma_lib.evaluation.stress import deformed_frames
    from neuma_lib.io.hdf5 import read_arrays

    F = torch.from_numpy(read_arrays(known["rollout"], required=("F",), only=("F",))[0]["F"])
    F = F[deformed_frames(F)].reshape(-1, 3, 3)
    return F[:: max(1, len(F) // 4000)] if len(F) else None


def _import(options: argparse.Namespace) -> None:
    from neuma_lib.export.laws import import_law

    spec = import_law(options.source, options.target, substep=options.substep)
    print(f"{options.target}: {json.dumps(spec)}")


def _scene_export(options: argparse.Namespace) -> None:
    from neuma_lib.api import Scene
    from neuma_lib.export.laws import law_for_engine
    from neuma_lib.export.scenes import EngineScene, export_scene

    if not Path(options.source).is_dir():
        problem = "is not a folder"
        raise InputError(options.source, problem, "Give that of a method, for example results/Ball/neuma")
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


def _of_method(options: argparse.Namespace) -> "tuple[Law, dict[str, Any]]":
    """The law of a method's folder, and what `export_law` needs to know of it."""
    from neuma_lib.evaluation.law_export import head_commit
    from neuma_lib.project import cases
    from neuma_lib.project.project import Project

    if options.adaptor or options.dt is not None:
        problem = "it is a method's folder, whose adaptor and time step are known"
        raise InputError(options.source, problem, "Leave out --adaptor and --dt")
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


def _of_file(options: argparse.Namespace) -> "tuple[Law, dict[str, Any]]":
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
