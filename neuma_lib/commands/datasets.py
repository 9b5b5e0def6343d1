"""Commands ``dataset`` and ``score``."""

import argparse
from pathlib import Path
from typing import Any

from neuma_lib.commands.parsing import CONFIGFILE, add_command, argument
from neuma_lib.errors import InputError


def add_commands(commands: Any) -> None:
    """Add the commands to a parser."""
    layouts = ("neuma", "pac_nerf", "spring_gaus")
    scenes = "scenes to write (default: those of table1 and the random scenes)"
    add_command(
        commands,
        _dataset,
        "dataset: write scenes for other systems",
        "Writes images, masks and cameras of scenes in the layout that another system reads, and their true motions "
        "to a separate folder, truth. The scenes must have been rendered: snakemake --cores 2 dataset. "
        "docs/benchmark.md describes the files.",
        argument("--layout", required=True, choices=layouts, help="of the files"),
        argument("--out", required=True, metavar="DIR", help="folder to write"),
        argument("scenes", nargs="*", metavar="SCENE", help=scenes),
        CONFIGFILE,
    )
    positions = (
        "one .h5 or .npz with an array x (T, N, 3) in metres, or .ply files, one per frame, or their folder"
    )
    truth = "true motion: truth/SCENE.h5 of `neuma dataset`, or data/SCENE/truth.h5"
    table = "table to compare with, .csv (default: the first in docs/results that has the scene, if any)"
    add_command(
        commands,
        _score,
        "score: score positions that any method predicted",
        "Prints the errors of predicted positions by the measures of the tables, and their place in a table. Example: "
        "neuma score mine.npz --truth benchmark/truth/BouncyBall.h5",
        argument("files", nargs="+", metavar="FILE", help=positions),
        argument("--truth", required=True, metavar="FILE", help=truth),
        argument("--table", metavar="FILE", help=table),
    )


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
        problem = f"has no methods in the scene {scene}"
        raise InputError(table, problem, "Choose another --table, or leave it out")
    print(
        f"{scene}: {len(x)} frames, {metrics.pop('points')} points"
        + (f", compared with {table}" if table else "")
    )
    for name, value in metrics.items():
        unit = "mm" if name.endswith("_mm") else "1e-4 m^2"
        print(f"  {name.removesuffix('_mm'):18} {value:9.4f} {unit:9} {places.get(name, '')}".rstrip())
