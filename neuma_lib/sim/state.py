"""States of the particles at the frames that somebody asked for."""

from __future__ import annotations

from collections.abc import Callable
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
        held = self._each(lambda value: torch.cat([value, value[-1:].expand(count, *value.shape[1:])]))
        return replace(held, frames=self.frames + (self.frames[-1],) * count)

    def cpu(self) -> Trajectory:
        """The same in main memory."""
        return self._each(torch.Tensor.cpu)

    def _each(self, function: Callable[[Tensor], Tensor]) -> Trajectory:
        values = {name: getattr(self, name) for name in ("x", "v", "F", "C", "tracers")}
        return replace(self, **{name: function(value) for name, value in values.items() if value is not None})
