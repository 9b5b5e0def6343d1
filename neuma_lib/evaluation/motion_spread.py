"""A motion that is predicted with identified constants, and its uncertainty.

Laws are sampled from the uncertainty of the constants (`constants_draws`) and simulated. The spread of their
motions is that of the constants. The simulation has an error as well, so the square of the difference of two
resolutions is added, divided equally among the three axes. As of constants, the intervals are value +- quantile * std
with measured quantiles (`calibration`). Friction with obstacles is sampled independently of the law's constants.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
import trimesh
from torch import Tensor

from neuma_lib.errors import InputError
from neuma_lib.evaluation.constants_draws import constants_draws, stable_law
from neuma_lib.fitting.families import FRICTION
from neuma_lib.fitting.frame_batches import first_contact
from neuma_lib.fitting.identified import recorded_friction
from neuma_lib.geometry.shapes import place
from neuma_lib.geometry.volume import sample_volume
from neuma_lib.mechanics.law import Law
from neuma_lib.sim.batch import rollout_batch
from neuma_lib.sim.model import MPM
from neuma_lib.sim.rollout import rollout
from neuma_lib.sim.state import State

SHAPES = ("ball", "duck", "pawn", "cat", "fish", "bottle")
SPEED = 3.0  # of other motions [m/s]
CLEARANCE = 0.1
"""Height of another shape above the floor at the start [m], plus what it is lower than ``size``."""
DRAWS = 32  # sampled laws
_TOGETHER = 8  # simulations in memory
_ONE_STD = (0.158655, 0.841345)  # probabilities of a normal variable below -1 and 1 standard deviations


@dataclass(frozen=True)
class Launch:
    """A body in rigid motion at the start."""

    mesh: trimesh.Trimesh  # its surface [m]
    velocity: Sequence[float]  # [m/s]
    spin: Sequence[float] = (0.0, 0.0, 0.0)  # angular velocity about the centre of mass [rad/s]
    density: float = 1000.0  # [kg/m^3]

    def state(self, particles: int, seed: int) -> State:
        """The body filled with particles."""
        x = torch.as_tensor(sample_volume(self.mesh, particles, seed=seed), dtype=torch.float32)
        vol0 = torch.full((len(x),), float(self.mesh.volume) / len(x))
        return State.rigid(x, self.density * vol0, vol0, self.velocity, self.spin)


@dataclass(frozen=True)
class Resolution:
    """Simulator and number of particles."""

    model: MPM  # frames are steps of it
    particles: int  # of the body

    def path(self, launch: Launch, law: Law, frames: Sequence[int], points: Tensor, seed: int) -> Tensor:
        """Positions (T, M, 3) [m] of points (M, 3) of a body, computed on their device.

        Args:
            frames: steps of the model.
        """
        state, law = launch.state(self.particles, seed).to(points.device), law.to(points.device)
        with torch.no_grad():
            path = rollout(self.model, law, state, steps=frames[-1], frames=frames, tracers=points)
        return path.tracers


@dataclass(frozen=True)
class MotionSpread:
    """Predicted positions of points of a body."""

    first: int  # index of the first frame in contact. The motion depends on the law from there on.
    points: Tensor  # start positions [m], shape (M, 3)
    value: Tensor  # with the identified constants [m], shape (T, M, 3)
    std: Tensor  # standard deviation [m], of the same shape
    laplace_std: Tensor  # that of the Laplace approximation, without an error of the simulation
    failed: int  # number of sampled laws that left the grid or became non-finite


def other_motions(scene: Mapping[str, Any]) -> dict[str, Launch]:
    """Motions of the material of a scene that its video does not show.

    ``launch`` is the body from the same place at 3 m/s downwards, with the horizontal velocity and the spin reversed.
    ``shape`` is the next one of `SHAPES`, of the same size, which falls at 3 m/s on the floor.

    Args:
        scene: plain settings of a scene with one of `SHAPES`.
    """
    size, center, density = scene["size"], scene["center"], scene["density"]
    other = SHAPES[(SHAPES.index(scene["shape"]) + 1) % len(SHAPES)]
    across, _, along = scene["velocity"]
    again = place(scene["shape"], size, scene["height"], center)
    return {
        "launch": Launch(again, (-across, -SPEED, -along), [-w for w in scene["spin"]], density),
        "shape": Launch(
            place(other, size, 0.5 * size + CLEARANCE, center), (0.0, -SPEED, 0.0), density=density
        ),
    }


def predict_with_spread(
    identified: Mapping[str, Any],
    of: str,
    launch: Launch,
    resolutions: tuple[Resolution, Resolution],
    times: Sequence[float],
    points: int,
    model_std: float,
    seed: int,
    device: torch.device | str = "cpu",
) -> MotionSpread:
    """Predict a motion with the constants of an identified.json.

    Args:
        identified: content of the file.
        of: its entry with the constants, "best" or "material".
        launch: the body, which may be another one than that of the video.
        resolutions: the coarser one, and that of the prediction.
        times: of the frames [s], ascending, whole numbers of steps of both.
        points: number of points, which are particles of the prediction, evenly drawn.
        model_std: see `constants_draws`.
        device: of the simulations. The result is on the CPU.

    Raises:
        InputError: the body touches nothing before the last frame.
        NonFiniteError: the simulation with the identified constants is unstable.
    """
    fit = identified[of]
    of_friction = fit["quantities"].get(FRICTION, {})
    friction = of_friction.get("value", recorded_friction(identified))
    coarse, fine = (
        each if friction is None else replace(each, model=each.model.with_friction(friction))
        for each in resolutions
    )
    generator = np.random.default_rng(seed)
    state = launch.state(fine.particles, seed).to(device)
    own = torch.from_numpy(np.sort(generator.choice(len(state.x), min(points, len(state.x)), replace=False)))
    steps, coarse_steps = (steps_at(each.model, times) for each in (fine, coarse))
    stable_in = (fine.model, launch.density)
    centre = fine.path(launch, stable_law(fit, *stable_in), steps, state.x, seed)
    first = first_contact(fine.model, centre, state.vol0, steps)
    if first == len(steps):
        raise InputError("times", "the body touches nothing before the last one", "Simulate for longer")
    value = centre[first:, own].cpu()
    lower = stable_law(fit, coarse.model, launch.density)
    other = coarse.path(launch, lower, coarse_steps, state.x[own], seed + 1)[first:].cpu()
    remainder = (value - other).square().sum(-1, keepdim=True) / 3

    def half_width(laws: Sequence[Law], friction_std: float) -> tuple[Tensor, int]:
        """Half the central interval of the positions that has the probability of one standard deviation."""
        draws, sampled = generator.standard_normal(len(laws)), [value]
        models = [
            fine.model
            if friction is None
            else fine.model.with_friction(friction * math.exp(friction_std * draw))
            for draw in draws
        ]
        for k in range(0, len(laws), _TOGETHER):
            part = slice(k, k + _TOGETHER)
            on_device = [law.to(device) for law in laws[part]]
            paths = rollout_batch(models[part], on_device, state, steps=steps[-1], frames=steps)
            sampled += [path.x[first:, own].cpu() for path in paths if path is not None]
        low, high = torch.stack(sampled).quantile(torch.tensor(_ONE_STD), dim=0)
        return (high - low) / 2, len(laws) + 1 - len(sampled)

    drawn = {"dt": fine.model.dt, "count": DRAWS, "of": of, "stable_in": stable_in}
    laws = constants_draws(identified, model_std, seed=seed, **drawn)
    spread, failed = half_width(laws, of_friction.get("log_std", 0.0))
    laws = constants_draws({**identified, "ties": []}, 0.0, seed=seed + 1, covariance="laplace", **drawn)
    plain, _ = half_width(laws, of_friction.get("laplace_log_std", 0.0))
    std = (spread.square() + remainder).sqrt()
    return MotionSpread(first, state.x[own].cpu(), value, std, plain, failed)


def steps_at(model: MPM, times: Sequence[float]) -> list[int]:
    """Steps of a simulator at times [s]."""
    return [round(time / model.dt) for time in times]
