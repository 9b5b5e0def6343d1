"""Which part of a reconstruction changes the constants that are found: one after the other is made right, or wrong.

    python -m benchmarks.twin SandFish                            # reads data/, results/, config/config.yaml

The true family is fitted from the true constants, so that it stays there if nothing else is wrong. A line says what was
simulated, the RMSE of tracers under the true law and under the found one [mm], and the errors of the found moduli and
constants [%]. First to the images of the training view as `identify` does, at its finest squares, where errors stand
with their estimated standard deviations; then to the true motion of tracers. The throw is the true one where a line
does not say otherwise. Dataset and reconstruction must exist (`snakemake results/SCENE/velocity.json`). The truth is
read here; nothing is tuned to it.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
import trimesh
from scipy.optimize import least_squares
from torch import Tensor

from benchmarks.outside import DIFFERENCE, EVALUATIONS, LOST, rmse
from benchmarks.project_scenes import chosen_scenes, scene_parser, simulator
from neuma_lib.config.settings import Config
from neuma_lib.coupling.reconstruction import Reconstruction
from neuma_lib.errors import InputError, NonFiniteError
from neuma_lib.fitting.families import Family
from neuma_lib.fitting.identify import identify
from neuma_lib.fitting.throw import Throw
from neuma_lib.geometry.shapes import place
from neuma_lib.geometry.volume import sample_volume
from neuma_lib.io.files import read_json
from neuma_lib.io.hdf5 import read_arrays
from neuma_lib.io.images import load_observation
from neuma_lib.io.mesh import read_mesh
from neuma_lib.io.particles import load_body
from neuma_lib.mechanics.analytic import analytic_law
from neuma_lib.mechanics.combinations import Values, named_combinations
from neuma_lib.sim.rollout import rollout
from neuma_lib.sim.state import State

TRACERS = 4000  # of the truth's
SEEDS = (11, 12)  # of particles
MANY = 8000  # particles of the bodies that images are compared with
SHIFT = 1e-3  # [m]


class Twin:
    """A scene's truth, its reconstruction, and what lies between them."""

    def __init__(self, name: str, settings: Config):
        self.scene = settings.scene(name)
        if not isinstance(self.scene.density, (int, float)):
            raise InputError(f"{name}: this benchmark takes bodies of one density only")
        self.settings, self.model = settings, simulator(settings, self.scene)
        self.few = settings.simulation.particles
        data, results = Path(settings.data_root) / name, Path(settings.results_root) / name
        wanted = ("x", "vol0", "tracers", "frames")
        arrays, _ = read_arrays(data / "particles.h5", required=wanted, only=wanted)
        some = np.random.default_rng(0).permutation(arrays["tracers"].shape[1])[:TRACERS]
        self.tracers = torch.from_numpy(arrays["tracers"][:, some])
        self.own, self.own_vol0 = (torch.from_numpy(a) for a in (arrays["x"][0], arrays["vol0"]))
        self.frames = arrays["frames"].tolist()
        scene = self.scene
        self.true_mesh = place(scene.shape, scene.size, scene.height, scene.center)
        self.mesh = read_mesh(results / "mesh.ply")
        self.law = scene.law.plain()
        self.family = Family("truth", {k: self.law[k] for k in ("elasticity", "plasticity") if k in self.law})
        self.truth = named_combinations(self.family.guess)
        files = (results / file for file in ("particles.h5", "binding.h5", "gaussians.ply"))
        chosen = settings.identify
        motion = dict(gaussian_motion=chosen.gaussian_motion)
        self.body = load_body(*files, scene.density, **motion).to(torch.float32)
        self.video = load_observation(data / "dynamic/transforms.json", chosen.views).to(torch.float32)
        self.throw = Throw.of(read_json(results / "velocity.json"))
        motion = (np.array(vector, dtype=float) for vector in (scene.velocity, scene.spin))
        self.true_throw = replace(self.throw, **dict(zip(("velocity", "spin"), motion)), std=np.zeros(6))
        family = {"truth": self.family.spec}
        self.chosen = type(chosen)(**{**chosen.plain(), "families": family, "squares": chosen.squares[-1:]})

    def thrown(self, x: Tensor, vol0: Tensor) -> State:
        """Particles in the true throw."""
        return State.thrown(x, self.scene.density * vol0, vol0, self.scene.velocity, self.scene.spin)

    def filled(self, mesh: trimesh.Trimesh, count: int, seed: int) -> State:
        """A body filled anew, in the true throw."""
        x = torch.as_tensor(sample_volume(mesh, count, seed), dtype=torch.float32)
        return self.thrown(x, torch.full((len(x),), float(mesh.volume) / len(x)))

    def bound(self, mesh: trimesh.Trimesh, seed: int) -> Reconstruction:
        """The reconstructed Gaussians on a body filled anew with many particles."""
        x = torch.from_numpy(sample_volume(mesh, MANY, seed))
        return self.body.resampled(x, mesh.volume, self.scene.density, self.settings.binding)

    def moved(self, law: Mapping[str, Any], start: State) -> Tensor | None:
        """Tracers (T, M, 3) under a law; None where it diverges."""
        law, how = analytic_law(law, self.model.dt), dict(steps=self.frames[-1], frames=self.frames)
        try:
            with torch.no_grad():
                return rollout(self.model, law, start, tracers=self.tracers[0], **how).tracers
        except NonFiniteError:
            return None

    def error(self, values: Values, start: State) -> float:
        """RMSE of tracers [mm]."""
        found = self.moved(self.family.law_spec(values), start)
        return math.nan if found is None else rmse(found, self.tracers)

    def by_tracers(self, start: State) -> Values:
        """Constants with the least RMSE of tracers."""

        def residual(u: np.ndarray) -> np.ndarray:
            values = self.family.values(u, self.model, self.scene.density)
            found = self.moved(self.family.law_spec(values), start)
            gap = torch.full_like(self.tracers, LOST) if found is None else found - self.tracers
            return gap.numpy().ravel()

        def jacobian(u: np.ndarray) -> np.ndarray:
            here = residual(u)
            return (
                np.stack([residual(u + step) - here for step in DIFFERENCE * np.eye(len(u))], 1) / DIFFERENCE
            )

        first = self.family.unbounded(self.family.guess)
        found = least_squares(residual, first, jacobian, xtol=2e-3, ftol=2e-3, max_nfev=EVALUATIONS)
        return self.family.values(found.x, self.model, self.scene.density)

    def motions(self) -> Iterator[tuple[str, State]]:
        """Starts that tracers are followed from."""
        yield "truth's own particles", self.thrown(self.own, self.own_vol0)
        for mesh, which, count in (
            (self.true_mesh, "true mesh", MANY),
            (self.true_mesh, "true mesh", self.few),
            (self.mesh, "our mesh", self.few),
        ):
            for seed in SEEDS:
                yield f"{which}, {count}, seed {seed}", self.filled(mesh, count, seed)
        yield "our particles", self.thrown(self.body.x0, self.body.vol0)
        yield "our particles, estimated throw", self.throw.of_body(self.body)

    def pictures(self) -> Iterator[tuple[str, Throw, Reconstruction, list[Reconstruction]]]:
        """Name, throw, body, and bodies that correct it, whose images are compared."""
        known, own = (
            self.true_throw,
            self.body.resampled(self.own, self.true_mesh.volume, self.scene.density, self.settings.binding),
        )
        larger = (self.true_mesh.volume / self.mesh.volume) ** (1 / 3)
        yield "truth's own particles", known, own, []
        for name, mesh, seeds in (
            ("true mesh", self.true_mesh, SEEDS),
            ("our mesh", self.mesh, SEEDS),
            ("true mesh, shrunk by 1 mm", grown(self.true_mesh, -SHIFT), SEEDS[:1]),
            ("true mesh, 1 mm higher", lifted(self.true_mesh, SHIFT), SEEDS[:1]),
            ("true mesh, 1 mm lower", lifted(self.true_mesh, -SHIFT), SEEDS[:1]),
            ("our mesh, grown by 1 mm", grown(self.mesh, SHIFT), SEEDS[:1]),
            ("our mesh, scaled to the true volume", scaled(self.mesh, larger), SEEDS[:1]),
        ):
            for seed in seeds:
                yield f"{name}, {MANY}, seed {seed}", known, self.bound(mesh, seed), []
        finer = [self.bound(self.mesh, seed) for seed in SEEDS]
        yield "our particles, true throw", known, self.body, finer
        yield "our particles", self.throw, self.body, finer


def grown(mesh: trimesh.Trimesh, by: float) -> trimesh.Trimesh:
    """A body with its surface moved outwards [m]."""
    return trimesh.Trimesh(mesh.vertices + by * mesh.vertex_normals, mesh.faces, process=False)


def lifted(mesh: trimesh.Trimesh, by: float) -> trimesh.Trimesh:
    """A body farther up [m]."""
    return trimesh.Trimesh(mesh.vertices + [0, by, 0], mesh.faces, process=False)


def scaled(mesh: trimesh.Trimesh, factor: float) -> trimesh.Trimesh:
    """A larger body about its centre of mass."""
    centre = mesh.center_mass
    return trimesh.Trimesh(centre + factor * (mesh.vertices - centre), mesh.faces, process=False)


def main() -> None:
    parser = scene_parser(__doc__, nargs="+")
    args = parser.parse_args()
    torch.set_num_threads(1)
    chosen = {name: settings for name, settings in chosen_scenes(args).items() if name in args.scenes}
    if not chosen:
        parser.error("there is no such scene")
    for name, settings in chosen.items():
        twin = Twin(name, settings)
        print(
            f"{name}: volume of the mesh {twin.mesh.volume / twin.true_mesh.volume - 1:+.1%} of the true one"
        )
        print("images:")
        for label, throw, body, finer in twin.pictures():
            fit = identify(twin.model, throw, body, twin.video, twin.chosen, finer=[finer]).best
            errors = ", ".join(
                f"{key} {value / twin.truth[key] - 1:+.0%} ({math.log(value / twin.truth[key]) / std:+.1f})"
                for key, value, std in fit.quantities(twin.chosen)
            )
            before = twin.error(twin.family.guess, throw.of_body(body))
            after = twin.error(fit.values, fit.throws[0].of_body(body))
            print(f"    {label:44} {before:5.2f} {after:5.2f}  {errors}", flush=True)
        print("tracers:")
        for label, start in twin.motions():
            found = named_combinations(values := twin.by_tracers(start))
            errors = ", ".join(f"{key} {found[key] / true - 1:+.0%}" for key, true in twin.truth.items())
            before, after = (twin.error(each, start) for each in (twin.family.guess, values))
            print(f"    {label:44} {before:5.2f} {after:5.2f}  {errors}", flush=True)


if __name__ == "__main__":
    main()
