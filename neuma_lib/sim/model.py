"""Constants of a simulation: grid, time step, gravity, walls, and the laws of ranges of particles."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import accumulate

import torch
from torch import Tensor

from neuma_lib.errors import InputError
from neuma_lib.mechanics.catalogue import COURANT_LIMIT
from neuma_lib.mechanics.law import Law, Weights

WALLS = ("x_min", "x_max", "y_min", "y_max", "z_min", "z_max")
CONDITIONS = ("no_slip", "slip", "sticky")
FORMS = ("outside", "released")
_OUTSIDE = 2
"""Nodes outside the cube at either end of an axis, all of them wall nodes, for "outside" walls."""


@dataclass(frozen=True)
class MPM:
    """Constants of the material point method on the unit cube.

    Nodes lie at integer multiples of dx = 1 / grid. A particle interacts with a wall if its stencil of three nodes per
    axis contains a wall node, i.e. within 1.5 dx of one. It stops half a cell behind the first wall node, where the
    stencil contains wall nodes only. There are two forms of walls:

    - "outside": the first wall nodes are one cell outside the cube, at -dx and 1 + dx, with a second one behind each to
      complete the stencil of every reachable position. Contact starts half a cell inside the cube. A body rests with
      its lowest particles within 0.4 cells of y = 0, soft bodies below it and stiff ones above. Particles move only by
      their velocity.
    - "released": as in the authors' code. Nodes are 0 ... grid - 1, of which the first and last ``wall_cells`` are
      walls. Contact starts ``wall_cells + 0.5`` cells inside the cube (one more at the far end), and positions are
      clamped to where the stencil exists, 0.5 dx to 1 - 1.5 dx. With one wall cell the clamp permanently creases soft
      bodies, because it does not change their deformation gradients.

    Attributes:
        grid: cells along an edge of the cube.
        dt: time step [s].
        gravity: acceleration [m/s^2], y is up.
        boundary: boundary condition, one name for all walls or one per wall (keys `WALLS`, default "no_slip").
            "no_slip" stops a wall node whose velocity points into the wall, "slip" removes only the component that
            points into the wall, "sticky" always stops wall nodes.
        walls: form of the walls, one of `FORMS`.
        wall_cells: thickness of released walls [nodes].

    Raises:
        InputError: a value is out of range or unknown.
    """

    grid: int
    dt: float
    gravity: tuple[float, float, float] = (0.0, -9.8, 0.0)
    boundary: str | Mapping[str, str] | tuple[str, ...] = "no_slip"
    walls: str = "outside"
    wall_cells: int = 1

    def __post_init__(self):
        if not isinstance(self.grid, int) or self.grid < 6:
            raise InputError("grid", f"{self.grid!r} must be an integer of at least 6 cells along an edge")
        if not (isinstance(self.dt, (int, float)) and math.isfinite(self.dt) and self.dt > 0):
            raise InputError("dt", f"{self.dt!r} must be a positive time step [s]")
        gravity = tuple(float(g) for g in self.gravity)
        if len(gravity) != 3 or not all(math.isfinite(g) for g in gravity):
            raise InputError("gravity", f"{self.gravity!r} must be three finite accelerations [m/s^2]")
        if self.walls not in FORMS:
            raise InputError("walls", f"{self.walls!r} must be one of {', '.join(FORMS)}")
        largest = (self.grid - 4) // 2 if self.walls == "released" else 1
        if not isinstance(self.wall_cells, int) or not 1 <= self.wall_cells <= largest:
            limits = f"1 to {largest} for {self.walls} walls and {self.grid} cells"
            raise InputError("wall_cells", f"{self.wall_cells!r} must be an integer from {limits}")
        object.__setattr__(self, "gravity", gravity)
        object.__setattr__(self, "boundary", _six_conditions(self.boundary))

    @property
    def dx(self) -> float:
        """Node spacing [m]."""
        return 1.0 / self.grid

    @property
    def clamps(self) -> bool:
        """Whether positions are clamped to where their stencil exists."""
        return self.walls == "released"

    @property
    def wall_nodes(self) -> int:
        """Wall nodes at either end of an axis."""
        return self.wall_cells if self.walls == "released" else _OUTSIDE

    @property
    def first_node(self) -> int:
        """Coordinate of the first node of an axis [dx]."""
        return 0 if self.walls == "released" else -_OUTSIDE

    @property
    def nodes(self) -> int:
        """Nodes along an edge of the grid."""
        return self.grid if self.walls == "released" else self.grid + 1 + 2 * _OUTSIDE

    @property
    def stencil_range(self) -> tuple[float, float]:
        """Closed interval of coordinates at which the stencil exists [m]."""
        if self.walls == "released":
            return 0.5 * self.dx, 1.0 - 1.5 * self.dx
        return (0.5 - _OUTSIDE) * self.dx, 1.0 + (_OUTSIDE - 0.5) * self.dx

    @property
    def free_range(self) -> tuple[float, float]:
        """Open interval of coordinates without wall nodes in the stencil [m]."""
        if self.walls == "released":
            return (self.wall_cells + 0.5) * self.dx, 1.0 - (self.wall_cells + 1.5) * self.dx
        return 0.5 * self.dx, 1.0 - 0.5 * self.dx

    def courant(self, law: Law, rho: float) -> float:
        """Courant number c dt / dx for the wave speed of a law at F = I and a density rho [kg/m^3]."""
        return law.wave_speed(rho) * self.dt / self.dx

    def check_courant(self, law: Law, rho: float) -> float:
        """Courant number of a law. Raises InputError if it exceeds `COURANT_LIMIT`."""
        number = self.courant(law, rho)
        if not number <= COURANT_LIMIT:
            stable = self.dt * COURANT_LIMIT / number
            raise InputError(
                "dt",
                f"{self.dt:g} s gives law {law.name!r} a Courant number of {number:.3g} > {COURANT_LIMIT} on a "
                f"{self.grid}^3 grid",
                f"Use dt <= {stable:.3g} s",
            )
        return number


@dataclass(frozen=True)
class MaterialRegion:
    """Particles ``start`` to ``stop`` (excluded) follow ``law``."""

    law: Law
    start: int
    stop: int


def law_weights(law: Law, dtype: torch.dtype) -> tuple[Weights, Weights]:
    """Weights of the elasticity and plasticity of a law in the precision ``dtype``."""
    elastic, plastic = law.weights()
    return tuple(w.to(dtype) for w in elastic), tuple(w.to(dtype) for w in plastic)


def as_regions(law: Law | Sequence[MaterialRegion], count: int) -> tuple[MaterialRegion, ...]:
    """Regions that cover `count` particles in order. A single law applies to all particles.

    Raises:
        InputError: the ranges overlap, have a gap, or do not end at `count`.
    """
    if isinstance(law, Law):
        return (MaterialRegion(law, 0, count),)
    regions = tuple(law)
    expected = 0
    for region in regions:
        if region.start != expected or region.stop <= region.start:
            raise InputError(
                f"region {region.law.name!r}",
                f"particles {region.start} to {region.stop} must be a range that starts at {expected}",
            )
        expected = region.stop
    if expected != count:
        raise InputError("regions", f"particles 0 to {expected} must be all of the {count} particles")
    return regions


def consecutive(laws: Sequence[Law], counts: Sequence[int]) -> tuple[MaterialRegion, ...]:
    """Consecutive regions with the given laws and numbers of particles."""
    ends = list(accumulate(counts))
    return tuple(MaterialRegion(law, end - n, end) for law, n, end in zip(laws, counts, ends, strict=True))


def contact_clearance(model: MPM, x: Tensor) -> Tensor:
    """Smallest distance [m] of particles x (..., N, 3) to the contact zone of the walls, <= 0 in contact."""
    low, high = model.free_range
    return torch.minimum(x - low, high - x).amin(dim=(-2, -1))


def _six_conditions(boundary: str | Mapping[str, str] | Sequence[str]) -> tuple[str, ...]:
    """Condition of each wall in the order of `WALLS`."""
    if isinstance(boundary, str):
        conditions = (boundary,) * 6
    elif isinstance(boundary, Mapping):
        unknown = sorted(set(boundary) - set(WALLS))
        if unknown:
            raise InputError("boundary", f"{unknown[0]!r} must be one of {', '.join(WALLS)}")
        conditions = tuple(boundary.get(wall, "no_slip") for wall in WALLS)
    else:
        conditions = tuple(boundary)
        if len(conditions) != 6:
            raise InputError(
                "boundary", f"{len(conditions)} conditions must be one per wall: {', '.join(WALLS)}"
            )
    for condition in conditions:
        if condition not in CONDITIONS:
            raise InputError("boundary", f"{condition!r} must be one of {', '.join(CONDITIONS)}")
    return conditions
