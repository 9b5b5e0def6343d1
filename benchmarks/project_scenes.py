"""Scenes of a project on the command line of a benchmark: which ones, with which settings, in which folders."""

from __future__ import annotations

import argparse
from functools import reduce
from typing import Any

from neuma_lib.config.scenes import SceneConfig
from neuma_lib.project.loading import load, merged, read_yaml
from neuma_lib.project.settings import Config
from neuma_lib.sim.model import MPM


def scene_parser(description: str, nargs: str) -> argparse.ArgumentParser:
    """A parser of scenes' names and of where to look for them."""
    parser = argparse.ArgumentParser(
        description=description, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("scenes", nargs=nargs, help="names, or their beginnings")
    parser.add_argument("--settings", nargs="+", default=["config/config.yaml"], help="YAML files")
    parser.add_argument("--seeds", type=int, nargs="*", default=[], help="of random scenes")
    parser.add_argument("--count", type=int, default=12, help="of random scenes of each seed")
    parser.add_argument("--data", dest="data_root", help="instead of data_root")
    parser.add_argument("--results", dest="results_root", help="instead of results_root")
    return parser


def chosen_scenes(args: argparse.Namespace) -> dict[str, Config]:
    """Settings by name of the scenes that are asked for; of all, if none is."""
    folders = {key: path for key in ("data_root", "results_root") if (path := getattr(args, key))}
    raw = reduce(merged, [*map(read_yaml, args.settings), folders])
    drawn = [{"random": {"seed": seed, "count": args.count}} for seed in args.seeds]
    return {
        name: settings
        for settings in (load(merged(raw, draw)) for draw in drawn or [{}])
        for name in settings.scenes
        if not args.scenes or any(name == given or name.startswith(f"{given}_") for given in args.scenes)
    }


def simulation(settings: Config, scene: SceneConfig) -> dict[str, Any]:
    """Constants of the simulator for a scene's reconstruction, as `MPM` takes them."""
    known = settings.simulation.plain()
    return {"dt": scene.dt, **{key: known[key] for key in ("grid", "gravity", "boundary", "walls")}}


def simulator(settings: Config, scene: SceneConfig) -> MPM:
    """The simulator for a scene's reconstruction."""
    return MPM(**simulation(settings, scene))
