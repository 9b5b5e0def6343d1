"""Why the true law's pixel loss is high: the same loss with one part of the reconstruction after the other made right.

    python -m benchmarks.bias RubberPawn                          # reads data/, results/, config/config.yaml
    python -m benchmarks.bias random1_05 --seeds 1 --scan         # also: where each constant's loss is lowest

A scene may be named by the beginning of its name. Dataset and reconstruction must exist (`snakemake
results/SCENE/velocity.json`). The truth is read here; nothing is fitted to it. Losses are those of the training view.

Columns of a line: how Gaussians are stretched and how they follow their particles (`material.covariance_from`,
`material.gaussian_motion`), the start, and the loss over all frames, before contact, and in the last frame. "true
particles" are not simulated: the truth carries the reconstructed particles, so that what is left is the rendering.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from benchmarks.project_scenes import chosen_scenes, scene_parser, simulator
from neuma_lib.config.settings import Config
from neuma_lib.coupling.reconstruction import Reconstruction
from neuma_lib.fitting.frame_batches import frame_batches
from neuma_lib.fitting.throw import Throw
from neuma_lib.geometry.skinning import carry, skinning_matrix
from neuma_lib.io.files import read_json
from neuma_lib.io.hdf5 import read_arrays
from neuma_lib.io.images import load_observation
from neuma_lib.io.particles import load_body
from neuma_lib.mechanics.analytic import analytic_law
from neuma_lib.sim.model import MPMModel, contact_clearance
from neuma_lib.sim.rollout import rollout
from neuma_lib.sim.state import State, Trajectory
from neuma_lib.splatting.observation import Observation

SCANNED = (-0.3, -0.15, 0.0, 0.15, 0.3)
"""Changes of the logarithm of a constant; of a friction angle, of its slope in the Drucker-Prager cone."""
STRETCH = 1e-3  # distance over which the truth's deformation is measured [m]
MOTIONS = {"shift": False, "affine": True}


@dataclass
class Scene:
    """A scene with its reconstruction and its truth."""

    model: MPMModel
    law: Mapping[str, Mapping[str, Any]]
    body: Reconstruction
    video: Observation
    starts: dict[str, State]
    truth: np.ndarray

    @classmethod
    def read(cls, name: str, settings: Config) -> Scene:
        scene = settings.scene(name)
        data, results = Path(settings.data_root) / name, Path(settings.results_root) / name
        files = (results / file for file in ("particles.h5", "binding.h5", "gaussians.ply"))
        body = load_body(*files, scene.density).to(torch.float32)
        video = load_observation(data / "dynamic/transforms.json", (0,)).to(torch.float32)
        arrays, _ = read_arrays(data / "particles.h5", required=("x", "mass"), only=("x", "mass"))
        centre = torch.from_numpy(np.average(arrays["x"][0], axis=0, weights=arrays["mass"]))
        starts = {
            "estimated start": Throw.of(read_json(results / "velocity.json")).of_body(body),
            "true start": body.state(scene.velocity, scene.spin, centre),
        }
        return cls(simulator(settings, scene), scene.law.plain(), body, video, starts, arrays["x"])

    def path(self, law: Mapping[str, Mapping[str, Any]], start: str) -> Trajectory:
        """Rollout over the video's frames."""
        frames = self.video.frames
        with torch.no_grad():
            law = analytic_law(law, self.model.dt)
            return rollout(self.model, law, self.starts[start], steps=frames[-1], frames=frames, total=True)

    def carried(self) -> tuple[Tensor, Tensor]:
        """Positions (T, N, 3) [m] and deformations (T, N, 3, 3) of the particles in the truth."""
        x0 = self.body.x0.double().numpy()
        offsets = STRETCH * np.concatenate([np.zeros((1, 3)), np.eye(3), -np.eye(3)])
        moved = carry(skinning_matrix((x0 + offsets[:, None]).reshape(-1, 3), self.truth[0]), self.truth)
        moved = moved.reshape(len(moved), 7, -1, 3)
        F = np.moveaxis(moved[:, 1:4] - moved[:, 4:], 1, 3) / (2 * STRETCH)
        return torch.from_numpy(moved[:, 0]).float(), torch.from_numpy(F).float()

    def losses(self, x: Tensor, F: Tensor, motion: str) -> Tensor:
        """Loss of every frame, shape (T,)."""
        renderer = replace(self.body, affine=MOTIONS[motion]).particle_gs(self.video.cameras)
        with torch.no_grad():
            return torch.cat([
                renderer.error(x[part], F[part], self.video.stored(part))
                for part in frame_batches(len(x), renderer.frames_per_batch)
            ])  # fmt: skip


def ingredients(scene: Scene) -> Iterator[tuple[str, Tensor]]:
    """Losses (T,) of the true law, with more and more of the truth."""
    for start in scene.starts:
        path = scene.path(scene.law, start)
        for motion in MOTIONS:
            yield f"elastic F, {motion}, {start}", scene.losses(path.x, path.F, motion)
            yield f"total F, {motion}, {start}", scene.losses(path.x, path.F_total, motion)
    for motion in MOTIONS:
        yield f"true particles, {motion}", scene.losses(*scene.carried(), motion)


def scanned(scene: Scene, start: str) -> Iterator[tuple[str, list[float]]]:
    """Mean losses over `SCANNED` of every constant, as the Gaussians are stretched and follow."""
    for part, given in scene.law.items():
        for key in [key for key in given if key not in ("name", "nu")]:
            found: dict[str, list[float]] = {}
            for change in SCANNED:
                law = {**scene.law, part: {**given, key: changed(key, given[key], change)}}
                path = scene.path(law, start)
                for name, F, motion in (
                    ("elastic F, shift", path.F, "shift"),
                    ("total F, shift", path.F_total, "shift"),
                    ("total F, affine", path.F_total, "affine"),
                ):
                    found.setdefault(name, []).append(float(scene.losses(path.x, F, motion).mean()))
            yield from ((f"{key}, {name}, {start}", losses) for name, losses in found.items())


def changed(key: str, value: float, change: float) -> float:
    """A constant whose logarithm (a friction angle's slope's) is changed."""
    if key != "friction_angle":
        return value * math.exp(change)
    sine = math.sin(math.radians(value))
    slope = 2 * sine / (3 - sine) * math.exp(change)
    return math.degrees(math.asin(min(3 * slope / (2 + slope), 0.999)))


def lowest(losses: list[float]) -> float:
    """Where a parabola through the least loss and its neighbours is lowest, within the scanned range."""
    middle = min(max(int(np.argmin(losses)), 1), len(SCANNED) - 2)
    near = slice(middle - 1, middle + 2)
    a, b, _ = np.polyfit(SCANNED[near], losses[near], 2)
    best = -b / (2 * a) if a > 0 else SCANNED[int(np.argmin(losses))]
    return float(np.clip(best, SCANNED[0], SCANNED[-1]))


def main() -> None:
    parser = scene_parser(__doc__, nargs="+")
    parser.add_argument(
        "--scan", action="store_true", help="change each constant by up to 35 percent as well"
    )
    args = parser.parse_args()
    torch.set_num_threads(1)
    chosen = chosen_scenes(args)
    if not chosen:
        parser.error("there is no such scene")
    for name, settings in chosen.items():
        scene = Scene.read(name, settings)
        clear = contact_clearance(scene.model, torch.from_numpy(scene.truth)) > 0
        flying = int(clear.int().cumprod(0).sum())
        print(f"{name}: {flying} of {len(clear)} frames before contact; losses x 1e-4")
        for label, losses in ingredients(scene):
            means = 1e4 * torch.stack([losses.mean(), losses[:flying].mean(), losses[-1]])
            print(f"    {label:36} " + " ".join(f"{value:8.2f}" for value in means.tolist()), flush=True)
        for start in scene.starts if args.scan else ():
            for label, losses in scanned(scene, start):
                shift = math.exp(lowest(losses)) - 1
                values = " ".join(f"{1e4 * loss:.2f}" for loss in losses)
                print(f"    {label:48} lowest at {shift:+.1%} of the truth ({values})", flush=True)


if __name__ == "__main__":
    main()
