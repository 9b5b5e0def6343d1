"""What constants can do for a truth that no family describes, and what a structured correction could.

    python -m benchmarks.outside OutsideFibres OutsidePaste
    python -m benchmarks.outside OutsideFoam --families bingham drucker_prager

No images: the truth is simulated on the particles of a reconstruction's size, every candidate family of `identify` is
fitted to their positions, and the structured law to stresses and returns that they saw. All are judged by the root mean
square distance of particles over the frames, so that 0 is reached by the true law. As a yardstick the truth itself is
simulated again with particles of another seed, and passive tracers of both compared: what a reconstruction cannot know.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
import torch
from scipy.optimize import least_squares
from torch import Tensor

from benchmarks.project_scenes import simulator
from neuma_lib.config.loading import load, read_yaml
from neuma_lib.config.scenes import SceneConfig
from neuma_lib.config.settings import Config
from neuma_lib.errors import InputError, NonFiniteError
from neuma_lib.evaluation.reports import as_markdown
from neuma_lib.fitting.families import Family
from neuma_lib.geometry.shapes import place
from neuma_lib.geometry.volume import sample_tracers, sample_volume
from neuma_lib.mechanics.adaptor import AdaptableConstitutive
from neuma_lib.mechanics.analytic import analytic_law
from neuma_lib.mechanics.combinations import Values
from neuma_lib.mechanics.law import Constitutive, Law
from neuma_lib.mechanics.structured import structured_law
from neuma_lib.sim.batch import rollout_batch
from neuma_lib.sim.rollout import rollout
from neuma_lib.sim.state import State, Trajectory

FRAMES, TRACERS = 32, 3000
SEED, OTHER_SEED = 3, 4
EVALUATIONS = 8
"""Linearisations of a fit of constants; on these truths later ones change the error by less than 1 %."""
DIFFERENCE = 0.02
"""Step of the difference quotients, of unbounded constants (logarithms, mostly)."""
LOST = 0.3
"""Distance [m] that counts along every axis where a rollout breaks."""
ITERATIONS, SAMPLES, RATE = 3000, 4000, 0.01
"""Of the fit of a structured law."""
STRAINED = 1e-3
"""Least |F - 1| of the states that it is fitted to."""


class Truth:
    """A scene's truth at the scale of its reconstruction."""

    def __init__(self, settings: Config, name: str):
        self.scene: SceneConfig = settings.scene(name)
        if not isinstance(self.scene.density, (int, float)):
            raise InputError(f"{name}: this benchmark takes bodies of one density only")
        self.density, self.spec = float(self.scene.density), self.scene.law.plain()
        self.model = simulator(settings, self.scene)
        self.law = analytic_law(self.spec, self.scene.dt)
        self.mesh = place(self.scene.shape, self.scene.size, self.scene.height, self.scene.center)
        self.count = settings.simulation.particles
        self.frames = [round(k * self.scene.steps / FRAMES) for k in range(FRAMES + 1)]
        self.start = self.body(SEED)
        self.x = self.run(self.law).x

    def body(self, seed: int) -> State:
        """The body filled with particles."""
        x = torch.as_tensor(sample_volume(self.mesh, self.count, seed=seed), dtype=torch.float32)
        vol0 = torch.full((len(x),), float(self.mesh.volume) / len(x))
        return State.thrown(x, self.density * vol0, vol0, self.scene.velocity, self.scene.spin)

    def run(self, law: Law, frames: list[int] | None = None, **start) -> Trajectory:
        frames = frames or self.frames
        start = {"state": self.start, **start}
        with torch.no_grad():
            return rollout(self.model, law, steps=frames[-1], frames=frames, **start)

    def error(self, law: Law) -> float:
        """RMSE of the particles [mm]; not a number where the rollout breaks."""
        try:
            return rmse(self.run(law).x, self.x)
        except NonFiniteError:
            return float("nan")

    def sampling(self) -> float:
        """RMSE of tracers under the true law with particles of two seeds [mm]."""
        tracers = torch.as_tensor(sample_tracers(self.mesh, TRACERS, seed=SEED), dtype=torch.float32)
        bodies = (self.start, self.body(OTHER_SEED))
        return rmse(*(self.run(self.law, state=body, tracers=tracers).tracers for body in bodies))

    def states(self) -> tuple[Tensor, Tensor]:
        """F and the F_trial of the next step (n, 3, 3) of all particles at the frames."""
        pairs = sorted({k for n in self.frames[1:-1] for k in (n, n + 1)})
        path = self.run(self.law, pairs)
        now, then = ([pairs.index(n + k) for n in self.frames[1:-1]] for k in (0, 1))
        trial = (torch.eye(3) + self.model.dt * path.C[then]) @ path.F[now]
        return path.F[now].reshape(-1, 3, 3), trial.reshape(-1, 3, 3)


def rmse(x: Tensor, y: Tensor) -> float:
    """Root mean square distance of corresponding points [mm]."""
    return 1e3 * float((x - y).square().sum(-1).mean().sqrt())


def best_constants(truth: Truth, family: Family) -> tuple[float, Values]:
    """Least RMSE [mm] of a family, and its constants, by least squares from what it shares with the truth."""
    known = {key: value for part in truth.spec.values() for key, value in part.items() if key != "name"}

    def residuals(points: list[np.ndarray]) -> list[np.ndarray]:
        specs = [family.law_spec(family.values(u, truth.model, truth.density)) for u in points]
        laws = [analytic_law(spec, truth.model.dt) for spec in specs]
        paths = rollout_batch(truth.model, laws, truth.start, steps=truth.frames[-1], frames=truth.frames)
        gaps = [torch.full_like(truth.x, LOST) if path is None else path.x - truth.x for path in paths]
        return [gap.numpy().ravel() for gap in gaps]

    def jacobian(u: np.ndarray) -> np.ndarray:
        here, *moved = residuals([u, *(u + DIFFERENCE * np.eye(len(u)))])
        return np.stack([(gap - here) / DIFFERENCE for gap in moved], axis=1)

    first = family.unbounded(family.with_guesses(known))
    found = least_squares(
        lambda u: residuals([u])[0], first, jacobian, xtol=2e-3, ftol=2e-3, max_nfev=EVALUATIONS
    )
    return 1e3 * float(np.sqrt(3 * np.mean(found.fun**2))), family.values(found.x, truth.model, truth.density)


def fitted_structure(truth: Truth, base: dict) -> tuple[Law, dict[str, float]]:
    """The structured law of a base with the truth's E and nu, fitted to its stresses and returns.

    Returns:
        The law, and for each part that has a network the relative error of what it was fitted to.
    """
    law = structured_law(base, truth.model.dt)
    F, trial = truth.states()
    errors = {}
    for name, part in law.parts.items():
        states, true = (F, truth.law.elasticity) if name == "elasticity" else (trial, truth.law.plasticity)
        unchanged = torch.zeros_like if name == "elasticity" else torch.clone
        errors[name] = _fit(part, true, states, unchanged)
    return law, errors


def _fit(part: AdaptableConstitutive, true: Constitutive, states: Tensor, unchanged) -> float:
    """Fit one part to the true one in the relative size of what these change; its relative error."""
    states = states[(states - torch.eye(3)).norm(dim=(1, 2)) > STRAINED]
    change = true.evaluate(states.double(), ()) - unchanged(states.double())
    size = change.norm(dim=(1, 2))
    unit = size[size > 0].median()
    generator = torch.Generator().manual_seed(0)
    weights = tuple(w.detach().clone() for w in part.weights())
    optimiser = torch.optim.Adam(weights, lr=RATE, betas=(0.9, 0.99))
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, ITERATIONS, 0.02 * RATE)

    def sampled(count: int) -> tuple[Tensor, Tensor, Tensor]:
        some = torch.randint(len(states), (count,), generator=generator)
        F = states[some]
        return F, part.evaluate(F, weights) - unchanged(F) - change[some].float(), size[some].float()

    for _ in range(ITERATIONS):
        F, gap, at = sampled(SAMPLES)
        slope = 2 / SAMPLES * gap / (at.square() + unit**2)[:, None, None]
        for weight, grad in zip(weights, part.vjp(F, weights, slope.float())[1], strict=True):
            weight.grad = grad
        optimiser.step()
        schedule.step()
    part.freeze(weights)
    _, gap, at = sampled(4 * SAMPLES)
    return float(gap.norm() / at.norm())


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("scenes", nargs="+")
    parser.add_argument("--families", nargs="*", help="candidates; all of them if not given")
    parser.add_argument("--settings", type=Path, default=Path("config/config.yaml"))
    options = parser.parse_args()
    torch.set_num_threads(1)
    settings = load(read_yaml(options.settings))
    candidates = settings.identify.families
    chosen = list(candidates) if options.families is None else options.families
    if unknown := set(chosen) - set(candidates):
        parser.error(f"no family {', '.join(sorted(unknown))}; choose from {', '.join(candidates)}")
    for name in options.scenes:
        truth = Truth(settings, name)
        rows = [("true, particles of another seed", f"{truth.sampling():.2f}", "")]
        for key in chosen:
            spec = candidates[key].plain()
            family = Family(key, {part: spec[part] for part in ("elasticity", "plasticity")})
            error, values = best_constants(truth, family)
            constants = ", ".join(f"{constant} {value:.3g}" for constant, value in values.items())
            rows.append((key, f"{error:.2f}", constants))
        law, errors = fitted_structure(truth, base_of(truth))
        shown = ", ".join(f"{part} {error:.1%}" for part, error in errors.items())
        rows.append((f"{law.name}, fitted to stresses", f"{truth.error(law):.2f}", shown))
        table = as_markdown(("law", "RMSE [mm]", "constants, or relative errors"), rows)
        print("\n".join([name, "", *table, ""]), flush=True)


def base_of(truth: Truth) -> dict:
    """Hencky elasticity of the truth's E and nu; flow beyond a yield stress where the truth is not elastic, and grains
    where it rubs. The start of a fit, so of the right order only."""
    elastic, plastic = truth.spec["elasticity"], truth.spec["plasticity"]
    base: dict = {"elasticity": {"name": "hencky", "E": elastic["E"], "nu": elastic["nu"]}}
    if "friction_angle" in plastic:
        angle = plastic["friction_angle"]
        base["plasticity"] = {"name": "drucker_prager", "friction_angle": angle, "cohesion": 1e-3}
    elif plastic["name"] != "identity":
        yield_stress = plastic.get("yield_stress") or plastic["crush"] / 2
        base["plasticity"] = {"name": "viscous_flow", "viscosity": 100.0, "yield_stress": yield_stress}
    return base


if __name__ == "__main__":
    main()
