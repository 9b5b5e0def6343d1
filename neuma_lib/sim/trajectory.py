"""States of the particles at the frames that somebody asked for."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor


@dataclass(frozen=True)
class Trajectory:
    """States of N particles (and positions of M tracers) at T frames.

    Attributes:
        frames: steps of the frames, increasing, 0 is the start.
        x: positions [m], shape (T, N, 3).
        v: velocities [m/s], shape (T, N, 3).
        F: elastic deformation gradients, shape (T, N, 3, 3).
        C: APIC affine velocities [1/s], shape (T, N, 3, 3).
        tracers: positions of passive tracers [m], shape (T, M, 3), or None.
    """

    frames: tuple[int, ...]
    x: Tensor
    v: Tensor
    F: Tensor
    C: Tensor
    tracers: Tensor | None = None

    def hold_last(self, count: int) -> Trajectory:
        """The same with the last frame repeated `count` times, for a rollout that stopped early."""

        values = {name: getattr(self, name) for name in ("x", "v", "F", "C", "tracers")}
        held = {
            name: torch.cat([value, value[-1:].expand(count, *value.shape[1:])])
            for name, value in values.items()
            if value is not None
        }
        return replace(self, frames=self.frames + (self.frames[-1],) * count, **held)
