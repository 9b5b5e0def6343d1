"""The total deformation of particles, plastic flow included, from a rollout that returns every step.

A simulation keeps the elastic part F only. The total one is the product of the increments that moved the particles,
F_total <- (I + dt C) F_total (paper Algorithm 2 without its return map); what has flowed stays in it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import torch

from neuma_lib.errors import InputError
from neuma_lib.sim.state import Trajectory


def every_step(frames: Sequence[int]) -> tuple[int, ...]:
    """Frames that `total_deformation` needs of a rollout to know the total deformation at ``frames``."""
    return tuple(range(frames[-1] + 1))


def total_deformation(path: Trajectory, dt: float, frames: Sequence[int]) -> Trajectory:
    """The states at some frames, with the total deformation in the place of F; differentiable.

    Args:
        path: states at `every_step`; steps that are held after a divergence do not deform.
        dt: time step [s].
        frames: steps that are wanted, increasing.

    Raises:
        InputError: the trajectory does not hold every step.
    """
    if len(path.frames) <= frames[-1] or path.frames[0] != 0:
        raise InputError(
            f"total deformation at step {frames[-1]} needs all steps, the trajectory has {len(path.frames)} frames:"
            " ask the rollout for `every_step(frames)`"
        )
    F = torch.eye(3, dtype=path.C.dtype, device=path.C.device).expand_as(path.C[0])
    wanted, found = set(frames), []
    for step in range(frames[-1] + 1):
        if step and path.frames[step] != path.frames[step - 1]:
            F = F + dt * (path.C[step] @ F)
        if step in wanted:
            found.append(F)
    return replace(path.at(frames), F=torch.stack(found), tracers=None)
