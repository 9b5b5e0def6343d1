"""Random motions of cubes in a box, on which priors are trained and evaluated."""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from neuma_lib.config.priors import RegressionConfig
from neuma_lib.mechanics.analytic import analytic_law
from neuma_lib.mechanics.law import Law
from neuma_lib.mechanics.singular_values import svd3
from neuma_lib.sim.model import MPM
from neuma_lib.sim.rollout import rollout
from neuma_lib.sim.state import State

Progress = Callable[[int, int, float | None], None]
"""Receives the number of finished iterations, the total number, and the loss."""
DENSITY = 1000.0  # density of every training cube [kg/m^3]
_COURANT = 0.5  # maximum Courant number
_SIDES = (0.15, 0.35)  # range of the sides of random cubes [m], in a box with a side of 1 m
_WALL_CLEARANCE = 0.1  # initial distance of the bounding sphere of a cube from the walls [m]
_LOWEST = 0.3  # lowest share of the possible initial heights that is used, so that cubes hit the floor soon
_VELOCITIES = ((-2.0, 2.0), (-4.0, -0.5), (-2.0, 2.0))  # ranges of the velocity along x, y and z [m/s]
_SPIN = 6.0  # largest angular velocity about each axis [rad/s]


@dataclass(frozen=True)
class Launch:
    """A cube of particles with its initial motion."""

    model: MPM
    state: State
    steps: int

    def run(self, law: Law, frames: list[int]):
        return rollout(self.model, law, self.state, steps=self.steps, frames=frames)


def reference_law(spec: Mapping[str, Any], settings: RegressionConfig) -> Law:
    """The analytic law, with the longest suitable time step if it depends on the rate."""
    law = analytic_law(spec, dt=settings.dt)
    return analytic_law(spec, dt=longest_step(law, settings))


def longest_step(law: Law, settings: RegressionConfig) -> float:
    """Time step of the settings, reduced to the maximum Courant number [s]."""
    return min(settings.dt, _COURANT / (settings.grid * law.wave_speed(DENSITY)))


def random_launch(
    law: Law, generator: torch.Generator, settings: RegressionConfig, speed: float = 1.0
) -> Launch:
    """A cube of random size, position, orientation, velocity and spin, with its motion scaled by ``speed``.

    Half of the launches use half the time step, to include its trial states, except for rate-dependent laws, because a
    network is trained for one step.
    """

    def uniform(low: float, high: float, *shape: int) -> Tensor:
        return low + (high - low) * torch.rand(shape, generator=generator)

    side = float(uniform(*_SIDES))
    rotation = random_rotations(1, generator)[0]
    reach = 0.5 * side * math.sqrt(3) + _WALL_CLEARANCE
    ticks = (torch.arange(settings.side_particles) + 0.5) / settings.side_particles - 0.5
    local = side * torch.cartesian_prod(ticks, ticks, ticks) @ rotation.mT
    centre = reach + (1 - 2 * reach) * uniform(0.0, 1.0, 3)
    centre[1] = reach + _LOWEST * (1 - 2 * reach) * float(uniform(0.0, 1.0))
    v = torch.cat([uniform(*speeds, 1) for speeds in _VELOCITIES])
    omega = uniform(-_SPIN, _SPIN, 3)
    halved = float(uniform(0.0, 1.0)) < 0.5 and "dt" not in getattr(law.plasticity, "constants", {})
    dt = longest_step(law, settings) * (0.5 if halved else 1.0)
    count = len(local)
    state = State(
        centre + local,
        speed * (v + torch.linalg.cross(omega.expand_as(local), local)),
        torch.full((count,), DENSITY * side**3 / count),
        torch.full((count,), side**3 / count),
    )
    return Launch(MPM(grid=settings.grid, dt=dt), state, math.ceil(settings.duration / dt))


def random_rotations(count: int, generator: torch.Generator) -> Tensor:
    """Uniformly distributed rotations (count, 3, 3)."""
    q = torch.randn(count, 4, generator=generator)
    w, x, y, z = (q / q.norm(dim=1, keepdim=True)).unbind(1)
    return torch.stack(
        [
            *(1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
            *(2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
            *(2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
        ],
        dim=1,
    ).reshape(-1, 3, 3)


def visited_stretches(launch: Launch, law: Law) -> tuple[Tensor, Tensor]:
    """Principal stretches of F and of F_trial in a rollout, (M, 3) each.

    F_trial = (I + dt C) F from pairs of consecutive frames.
    """
    firsts = list(range(0, launch.steps - 1, 8))
    frames = sorted({n for first in firsts for n in (first, first + 1)})
    path = launch.run(law, frames)
    before = [frames.index(n) for n in firsts]
    after = [frames.index(n + 1) for n in firsts]
    eye = torch.eye(3)
    trial = (eye + launch.model.dt * path.C[after]) @ path.F[before]
    return svd3(path.F.reshape(-1, 3, 3))[1], svd3(trial.reshape(-1, 3, 3))[1]
