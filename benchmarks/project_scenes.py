"""Scenes of a project for benchmarks: arguments that select them, settings and files."""

import argparse
from functools import reduce
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from benchmarks.timing import parser_of
from neuma_lib.config.identify import IdentifyConfig
from neuma_lib.config.scenes import SceneConfig
from neuma_lib.coupling.initial_motion import InitialMotion
from neuma_lib.coupling.reconstruction import Reconstruction
from neuma_lib.geometry.volume import sample_volume
from neuma_lib.io.files import read_json
from neuma_lib.io.hdf5 import read_arrays
from neuma_lib.io.mesh import read_mesh
from neuma_lib.io.particles import load_reconstruction
from neuma_lib.project.loading import load, merged, read_yaml
from neuma_lib.project.settings import Config
from neuma_lib.sim.model import MPM

TRACERS = 2000  # of the truth, with which motions are compared


def scene_parser(description: str, nargs: str) -> argparse.ArgumentParser:
    """A parser of names of scenes and of the folders of their files."""
    parser = parser_of(description)
    parser.add_argument("scenes", nargs=nargs, help="names, or their beginnings")
    parser.add_argument("--settings", nargs="+", default=["config/config.yaml"], help="YAML files")
    parser.add_argument("--seeds", type=int, nargs="*", default=[], help="of random scenes")
    parser.add_argument("--count", type=int, default=12, help="of random scenes of each seed")
    parser.add_argument("--data", dest="data_root", help="instead of data_root")
    parser.add_argument("--results", dest="results_root", help="instead of results_root")
    return parser


def chosen_scenes(args: argparse.Namespace) -> dict[str, Config]:
    """Settings by name of the scenes that are named, or of all."""
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
    friction = {} if scene.friction is None else {"boundary": scene.friction, "contact": "particles"}
    return {
        "dt": scene.dt,
        **{key: known[key] for key in ("grid", "gravity", "boundary", "contact")},
        **friction,
    }


def simulator(settings: Config, scene: SceneConfig) -> MPM:
    """The simulator for a scene's reconstruction."""
    return MPM(**simulation(settings, scene))


def true_tracers(settings: Config, name: str) -> tuple[Tensor, list[int]]:
    """At most about `TRACERS` evenly chosen tracers (T, M, 3) [m] of the true motion, and the steps of its frames."""
    names = ("tracers", "frames")
    arrays, _ = read_arrays(Path(settings.data_root) / name / "truth.h5", required=names, only=names)
    tracers = torch.from_numpy(arrays["tracers"])
    return tracers[:, :: max(1, tracers.shape[1] // TRACERS)].contiguous(), arrays["frames"].tolist()


def read_body(
    name: str, settings: Config, chosen: IdentifyConfig, device: torch.device | str = "cpu"
) -> tuple[Reconstruction, InitialMotion]:
    """Reconstruction of a scene in float32, and its estimated initial motion."""
    results = Path(settings.results_root) / name
    files = (results / file for file in ("particles.h5", "binding.h5", "gaussians.ply"))
    body = load_reconstruction(*files, settings.scene(name).density, gaussian_motion=chosen.gaussian_motion)
    return body.to(torch.float32, device), InitialMotion.of(read_json(results / "velocity.json"))


def refined_bodies(
    name: str, settings: Config, chosen: IdentifyConfig, body: Reconstruction
) -> list[Reconstruction]:
    """The body with more particles for the finer grid, if the settings ask for it."""
    if not chosen.refined_particles:
        return []
    mesh = read_mesh(Path(settings.results_root) / name / "mesh.ply")
    x = torch.from_numpy(sample_volume(mesh, chosen.refined_particles, 1))
    return [body.resampled(x, mesh.volume, settings.scene(name).density, settings.binding)]


def prior_of(settings: Config, scene: SceneConfig) -> dict[str, Any] | None:
    """Specification of the law of a scene's prior, if it is analytic."""
    known = settings.priors.laws.get(scene.prior)
    return known.plain() if known else None
