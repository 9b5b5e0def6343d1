"""Commands beside the workflow: ``python -m neuma_lib export-law`` and ``show-law``; ``-h`` says what they take."""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path
from typing import Any

from neuma_lib.config.places import law_files, law_origin
from neuma_lib.errors import InputError, NonFiniteError
from neuma_lib.evaluation.law_export import export_law, head_commit, show_law
from neuma_lib.io.exported import EXPORT, checked_export
from neuma_lib.io.files import existing
from neuma_lib.io.laws import RELEASED_ALPHA, load_law, load_laws
from neuma_lib.io.weights import read_weights
from neuma_lib.mechanics.adaptor import AdaptableLaw
from neuma_lib.mechanics.law import Law
from neuma_lib.project import settings_around


def main(words: list[str] | None = None) -> int:
    """Run a command; its exit status."""
    options = _parser().parse_args(words)
    try:
        options.run(options)
    except (InputError, NonFiniteError) as error:
        print(f"ERROR: {error}", file=sys.stderr)
        return 1
    return 0


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="python -m neuma_lib", description=__doc__)
    commands = parser.add_subparsers(required=True, metavar="command")
    export = commands.add_parser(
        "export-law", help="write a learned law into one file that says all about it"
    )
    export.set_defaults(run=_export)
    export.add_argument(
        "source", help="folder of a method, results/RubberPawn/neuma, or file of a law or prior"
    )
    export.add_argument("target", help="file to write, .safetensors")
    export.add_argument("--adaptor", help="with the file of a prior: adaptor, ours or a released *_lora.pt")
    export.add_argument(
        "--alpha", type=float, default=RELEASED_ALPHA, help="of a released adaptor (default %(default)g)"
    )
    export.add_argument(
        "--apart", action="store_true", help="keep prior and adaptor apart, so that w can be set later"
    )
    export.add_argument(
        "--weight", type=float, default=1.0, help="weight w of the adaptor when it is merged (default 1)"
    )
    export.add_argument("--dt", type=float, help="with a file: time step that it was learned at [s]")
    export.add_argument(
        "--any-step", action="store_true", help="allow other time steps than that of its learning"
    )
    export.add_argument("--page", help="picture of what the law says, .png or .pdf")
    export.add_argument(
        "--configfile", nargs="+", default=[], help="settings over config/config.yaml, as in the run"
    )
    show = commands.add_parser("show-law", help="print what the file of an exported law says of it")
    show.set_defaults(run=_show)
    show.add_argument("law", help="file of export-law")
    show.add_argument("--page", help="picture of what the law says, .png or .pdf")
    return parser


def _export(options: argparse.Namespace) -> None:
    source = Path(options.source)
    law, known = _of_method(options) if source.is_dir() else _of_file(options)
    if options.weight != 1.0:
        if options.apart:
            raise InputError(
                "--weight is that of a merged adaptor: leave out --apart, or set the weight later"
            )
        if not isinstance(law, AdaptableLaw):
            raise InputError(f"--weight: {source} is an analytic law, without an adaptor")
        law.set_adaptor_weight(options.weight)
        known["weight"] = options.weight
    about = export_law(options.target, law, apart=options.apart, page=options.page, **known)
    step = "" if about["dt"] is None else f", learned at dt = {about['dt']:g} s"
    print(f"{options.target}: {about['kind']}{step}" + (f"; {options.page}" if options.page else ""))


def _of_method(options: argparse.Namespace) -> tuple[Law, dict[str, Any]]:
    """The law of a method's folder, and what `export_law` is told of it."""
    if options.adaptor or options.dt:
        raise InputError(
            f"{options.source} is a method's folder, whose adaptor and step are known: leave them out"
        )
    place = Path(options.source).absolute()
    settings, root = settings_around(place, options.configfile)
    settings = settings.model_copy(update={"results_root": str(place.parent.parent)})
    scene, method = place.parent.name, place.name
    files = law_files(settings, scene, method)
    origin = law_origin(settings, scene, method)
    law = load_laws(
        origin["dt"],
        [files.spec] if files.spec else [],
        *([str(root / file)] if file else [] for file in (files.identified, files.prior, files.adaptor)),
    )[0]
    beside = {"metrics": place / "metrics.json", "rollout": place / "rollout.h5"}
    of_this = {name: file for name, file in beside.items() if file.is_file() and origin["scene"] == scene}
    return law, {**origin, **of_this, "any_step": options.any_step, "commit": head_commit(root)}


def _of_file(options: argparse.Namespace) -> tuple[Law, dict[str, Any]]:
    """The same of a file, with what an exported one already says."""
    source, said = existing(options.source, "name a method's folder in results/, or the file of a law"), {}
    if source.suffix == ".safetensors":
        _, metadata = read_weights(source)
        said = checked_export(metadata) if EXPORT in metadata else {}
    dt = options.dt or said.get("dt")
    if options.dt is not None and options.dt <= 0:
        raise InputError(f"--dt {options.dt:g}: give the time step in seconds, above zero")
    law = load_law(source, options.adaptor, dt, options.any_step, options.alpha)
    of_the_law = ("grid", "gravity", "density", "scale")
    if not options.adaptor:
        of_the_law += ("scene", "method", "prior", "weight", "commit", "metrics", "visited")
    kept = {key: said[key] for key in of_the_law if key in said}
    kept |= {"prior": source.name} if options.adaptor else {}
    any_step = options.any_step or said.get("any_step") is True
    return law, {**kept, "dt": said.get("dt") or dt, "any_step": any_step}


def _show(options: argparse.Namespace) -> None:
    print(json.dumps(show_law(options.law, options.page), indent=1))


if __name__ == "__main__":
    sys.exit(main())
