"""Chosen second launches against random ones: standard deviations and errors of the constants after a joint fit.

    python -m benchmarks.next_experiment --seeds 1 --count 6 --random 2 --candidates 16 --out chosen.json

Materials, shapes and first launches are the random scenes of development seeds. Videos are renders of the true body,
filled with particles that have one Gaussian each. The reconstruction has other and fewer particles and Gaussians, so
that residuals are correlated errors of a reconstruction. There is no Blender and no fit of Gaussians, hence a material
takes about a core minute. Only the true family is fitted. The choice does not read the truth. Results are
written after each material, and materials in the file are skipped.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from benchmarks.timing import core_seconds
from neuma_lib.config.blender import AppearanceConfig
from neuma_lib.config.identify import IdentifyConfig
from neuma_lib.config.next import NextConfig
from neuma_lib.coupling.bodies import coloured_solid
from neuma_lib.coupling.initial_motion import InitialMotion
from neuma_lib.coupling.reconstruction import Reconstruction
from neuma_lib.data.blender.appearance import colors_at
from neuma_lib.errors import InputError, NonFiniteError
from neuma_lib.fitting.candidate_experiments import as_cameras, placed
from neuma_lib.fitting.choose_next import Option, choose_next
from neuma_lib.fitting.identified import FamilyFit
from neuma_lib.fitting.identify import identify
from neuma_lib.fitting.next_experiment import Experiment, stds
from neuma_lib.geometry.shapes import place
from neuma_lib.geometry.volume import sample_volume
from neuma_lib.io.files import read_json, write_json
from neuma_lib.mechanics.analytic import analytic_law
from neuma_lib.mechanics.combinations import physical
from neuma_lib.project.loading import load, merged, read_yaml
from neuma_lib.project.settings import Config
from neuma_lib.sim.model import MPM
from neuma_lib.sim.rollout import rollout
from neuma_lib.splatting.cameras import Cameras
from neuma_lib.splatting.observation import Observation
from neuma_lib.splatting.viewpoints import video_views

GRID, COARSER = 20, 1.6  # cells, and the time step over that of the scene
TRUE, RECONSTRUCTED = 4000, 1200  # particles
FRAMES, PIXELS = 25, 96
STD = np.array([0.01, 0.01, 0.03, 0.05, 0.05, 0.05])  # of the estimate of the initial motion [m/s, rad/s]
STEPS = 32  # the steps of a video are a multiple of this


@dataclass
class Lab:
    """A hidden material and its object, which films launches."""

    law: dict[str, Any]
    truth: Reconstruction
    body: Reconstruction
    random: np.random.Generator

    @torch.no_grad()
    def film(
        self,
        model: MPM,
        truth: Reconstruction,
        body: Reconstruction,
        velocity: Sequence[float],
        spin: Sequence[float],
        steps: int,
    ) -> tuple[InitialMotion, Reconstruction, Observation]:
        """An estimate of the initial motion, the reconstruction at the start, and the video."""
        frames = tuple(round(k * steps / (FRAMES - 1)) for k in range(FRAMES))
        start = truth.state(velocity, spin)
        path = rollout(model, analytic_law(self.law, model.dt), start, steps=steps, frames=frames, total=True)
        like = Cameras(torch.eye(4)[None], torch.eye(3)[None], PIXELS, PIXELS)
        cameras = as_cameras(video_views(path.x.flatten(0, 1).numpy(), 1, PIXELS, PIXELS), like)
        images = truth.particle_gs(cameras)(path.x, path.stretch)
        axes = cameras.viewmats[0, :3, :3].double().numpy()
        centre = (body.mass @ body.x0 / body.mass.sum()).double().numpy()
        std = np.zeros(6) if model.clamps else STD
        exact = InitialMotion(np.array(velocity), np.array(spin), centre, axes, std)
        motion = exact.moved(self.random.standard_normal(6))
        return motion, body, Observation(frames, images, cameras)

    def repeat(self, option: Option) -> tuple[InitialMotion, Reconstruction, Observation]:
        """Do an experiment that was chosen."""
        from scipy.spatial.transform import Rotation

        own = option.settings
        R = Rotation.from_rotvec(own.get("rotation", (0.0, 0.0, 0.0))).as_matrix()
        centre = (own["center"][0], own["height"], own["center"][1])
        at = [placed(each, R, centre) for each in (self.truth, self.body)]
        return self.film(option.experiment.model, *at, own["velocity"], own["spin"], own["steps"])


def solid(scene, count: int, seed: int) -> Reconstruction:
    """The object of a scene, filled with particles."""
    mesh = place(scene.shape, scene.size, scene.height, scene.center)
    x0 = sample_volume(mesh, count, seed=seed)
    colors = torch.from_numpy(colors_at(mesh, x0, AppearanceConfig(**scene.plain()["appearance"])))
    body = coloured_solid(mesh, torch.as_tensor(x0, dtype=torch.float32), 1000.0, colors)
    return replace(body, gaussians=body.gaussians.to(dtype=torch.float32), affine=False)


def measure(settings: Config, name: str, count: int, random: int, seed: int) -> dict[str, Any]:
    """Standard deviations and errors of the constants of a material after one launch and after two."""
    scene = settings.scene(name)
    law = scene.plain()["law"]
    family = settings.random.family(name)
    chosen = IdentifyConfig(
        families={family: settings.identify.families[family]}, refined_particles=0, covariance_from="total"
    )
    simulation = settings.simulation
    model = MPM(GRID, COARSER * scene.dt, simulation.gravity, simulation.boundary, simulation.contact)
    steps = STEPS * max(1, round(scene.steps / COARSER / STEPS))
    bodies = [solid(scene, TRUE, 1000), solid(scene, RECONSTRUCTED, 1)]
    lab = Lab(law, *bodies, np.random.default_rng([seed, 5]))
    truth = physical({key: value for part in law.values() for key, value in part.items() if key != "name"})
    first = lab.film(model, *bodies, scene.velocity, scene.spin, steps)

    def summary(fit: FamilyFit) -> dict[str, Any]:
        logs = {key: math.log(value / truth[key]) for key, value in physical(fit.values).items()}
        return {"std": stds(fit, chosen), "error": logs}

    def joint(option: Option) -> dict[str, Any]:
        models = [model, option.experiment.model]
        both = identify(models, *first, chosen, other_videos=[lab.repeat(option)])
        return {
            "settings": option.settings,
            "predicted": stds(option.forecast.fit, chosen),
            **summary(both.best),
        }

    alone = identify(model, *first, chosen)
    result: dict[str, Any] = {"scene": name, "family": family, "alone": summary(alone.best)}
    motion, body, video = first
    filmed = Experiment(model, replace(alone.best.motions[0], std=motion.std), body, [video])
    limits = NextConfig(kinds=("launch",), candidates=count)
    started = core_seconds()
    selection = choose_next(alone.best, [filmed], chosen, limits, seed=seed)
    result |= {
        "seconds": core_seconds() - started,
        "before": selection.before,
        "chosen": joint(selection.options[0]),
    }
    drawn = lab.random.permutation(len(selection.options))[:random]
    return {**result, "random": [joint(selection.options[k]) for k in drawn]}


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--seeds", type=int, nargs="+", default=[1], help="development seeds of random scenes"
    )
    parser.add_argument("--count", type=int, default=6, help="materials of each seed")
    parser.add_argument("--candidates", type=int, default=40)
    parser.add_argument("--random", type=int, default=2, help="random second launches of each material")
    parser.add_argument("--out", type=Path, required=True)
    options = parser.parse_args()
    torch.set_num_threads(1)
    results = read_json(options.out) if options.out.is_file() else []
    for seed in options.seeds:
        raw = merged(read_yaml("config/config.yaml"), {"random": {"seed": seed, "count": options.count}})
        settings = load(raw)
        if not settings.random.is_development:
            raise InputError("--seeds", f"{seed} is not a development seed")
        for name in settings.random_scenes:
            if any(each["scene"] == name for each in results):
                continue
            try:
                own = measure(settings, name, options.candidates, options.random, seed)
            except (InputError, NonFiniteError) as error:
                own = {"scene": name, "refused": str(error)}
            results.append(own)
            write_json(options.out, results)
            print(summary_line(own), flush=True)
    print_table(results)


def spread(std: dict[str, float]) -> float:
    return math.exp(float(np.mean(np.log(list(std.values())))))


def summary_line(own: dict[str, Any]) -> str:
    if "refused" in own:
        return f"{own['scene']}: {own['refused']}"
    others = ", ".join(f"{100 * spread(each['std']):.1f}" for each in own["random"])
    return (
        f"{own['scene']}: {100 * spread(own['alone']['std']):.1f} %, chosen {100 * spread(own['chosen']['std']):.1f} % "
        f"(predicted {100 * spread(own['chosen']['predicted']):.1f} %), random {others} %, {own['seconds']:.0f} s"
    )


def print_table(results: Sequence[dict[str, Any]]) -> None:
    """Ratios of the standard deviations, their calibration, and errors in units of them."""
    done = [each for each in results if "refused" not in each and each["random"]]
    ratios = [
        math.log(spread(each["chosen"]["std"]) / spread(other["std"]))
        for each in done
        for other in each["random"]
    ]
    fits = [fit for each in done for fit in (each["chosen"], *each["random"])]
    predicted = [math.log(spread(fit["predicted"]) / spread(fit["std"])) for fit in fits]
    z = [abs(fit["error"][key]) / fit["predicted"][key] for fit in fits for key in fit["predicted"]]
    if not done:
        return
    print(f"{len(done)} materials, {len(results) - len(done)} refused")
    print(f"std of chosen over random launches, geometric mean: {math.exp(float(np.mean(ratios))):.2f}")
    print(f"chosen better: {sum(ratio < 0 for ratio in ratios)} of {len(ratios)}")
    quartiles = np.exp(np.quantile(predicted, (0.1, 0.5, 0.9)))
    print(
        "predicted over reported std, 10th, 50th and 90th percentile: "
        + ", ".join(f"{q:.2f}" for q in quartiles)
    )
    print(f"errors within 1 and 2 predicted std: {np.mean(np.less(z, 1)):.2f}, {np.mean(np.less(z, 2)):.2f}")


if __name__ == "__main__":
    main()
