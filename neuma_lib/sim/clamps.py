"""Regions of a body that follow a prescribed rigid motion."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from neuma_lib.errors import InputError
from neuma_lib.sim.motion import Motion, Vector, vector

HELD_SHARE = 0.05
"""Share of clamped mass above which a node is held. In a uniform body these are the nodes up to 0.83 cells beyond the
end of a clamp, where a quadratic B-spline has this share on the other side. Depending on where nodes are, the body then
moves as if the clamp ended up to 0.7 cells nearer or farther. With a larger share, too small a part of the weights at
the end of a clamp can be at held nodes: at 1 / 6 a layer of the body is up to 2 cells too long."""


@dataclass(frozen=True)
class Clamp(Motion):
    """Particles that start in a box follow a rigid motion until they are released.

    Clamped particles are not part of the material: they add neither mass nor stress to the grid. A node whose mass is
    clamped by a share of more than `HELD_SHARE` moves with the clamp instead. So the clamp is rigid, and a load does
    not creep: if clamped particles only had prescribed velocities, a node between them and the body would move by
    dt^2 f / m in each step under a constant force f. Clamped particles move exactly with the clamp, and their
    deformation turns with it, so that a release continues without a jump. A particle in several clamps follows the
    first.

    Attributes:
        lowest, highest: corners of the box at t = 0 [m].
        release: time [s] from which on the particles move freely.
        centre, rotation, velocity, spin, keyframes: prescribed motion, see `Motion`. Particles keep the pose in its
            frame that they have at t = 0.

    Raises:
        InputError: a value is out of range or unknown.
    """

    lowest: Vector
    highest: Vector
    release: float = math.inf
    centre: Vector = (0.0, 0.0, 0.0)
    rotation: Vector = (0.0, 0.0, 0.0)
    velocity: Vector = (0.0, 0.0, 0.0)
    spin: Vector = (0.0, 0.0, 0.0)
    keyframes: tuple[tuple[float, Vector, Vector], ...] = ()

    def __post_init__(self):
        for name in ("lowest", "highest"):
            object.__setattr__(self, name, vector(getattr(self, name), f"clamp.{name}"))
        if not all(low < high for low, high in zip(self.lowest, self.highest, strict=True)):
            raise InputError("clamp.highest", f"{self.highest} must exceed {self.lowest} on every axis")
        if not self.release > 0:
            raise InputError("clamp.release", f"{self.release!r} must be a time [s] after 0")
        self.check_motion("clamp")

    def holds(self, time: float, dt: float) -> bool:
        """Whether the particles follow the motion in the step that starts at a time [s]."""
        return time < self.release - 1e-6 * dt


def clamped_particles(clamps: Sequence[Clamp], x: Tensor) -> Tensor:
    """Index of the clamp of each particle at x (N, 3) [m] at t = 0, or -1, int32 (N,).

    Raises:
        InputError: a clamp has no particle.
    """
    result = torch.full((len(x),), -1, dtype=torch.int32, device=x.device)
    for index, clamp in reversed(list(enumerate(clamps))):
        low, high = x.new_tensor(clamp.lowest), x.new_tensor(clamp.highest)
        inside = ((x >= low) & (x <= high)).all(dim=1)
        if not inside.any():
            span = ", ".join(
                f"{a:.3g} to {b:.3g}" for a, b in zip(x.amin(0).tolist(), x.amax(0).tolist(), strict=True)
            )
            raise InputError(f"clamps[{index}]", "contains no particle", f"The body occupies {span} m")
        result[inside] = index
    return result
