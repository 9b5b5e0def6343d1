"""What stays constant in a simulation: grid, time step, gravity, walls, which law moves which particles."""

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
"""Nodes outside the cube at either end of an axis, all of them wall nodes, for the form of that name."""


@dataclass(frozen=True)
class MPMModel:
    """Constants of the material point method on the unit cube.

    Nodes lie at whole multiples of dx = 1 / grid. A particle is free where its stencil of three nodes along an axis
    sees no wall node, which it does within 1.5 dx of one. Half a cell beyond the first wall node it sees wall nodes
    only and stands still. There are two forms of walls:

    - "outside": the first wall nodes are one cell outside the cube, at -dx and 1 + dx, and behind each is a second
      one, which completes the stencil as far as a particle can come. So contact begins half a cell inside the cube,
      and a body rests with its lowest particles at y = 0, within 0.4 cells: soft ones below, stiff ones above. Only
      their velocity ever moves particles.
    - "released": as in the authors' code. Nodes are 0 ... grid - 1, the first and the last ``wall_cells`` of them are
      walls, contact begins ``wall_cells + 0.5`` cells (at the far end one more) inside the cube, and particles
      are clamped to where their stencil exists, 0.5 dx to 1 - 1.5 dx. With one wall cell the clamp presses a
      permanent crease into soft bodies, because their deformation gradients know nothing of it.

    Attributes:
        grid: cells along an edge of the cube.
        dt: time step [s].
        gravity: acceleration [m/s^2], y is up.
        boundary: condition of the walls, one name for all or one a wall (keys `WALLS`, others are "no_slip").
            "no_slip" stops a wall node whose velocity points into the wall, "slip" only removes the component
            that points into the wall, "sticky" stops wall nodes always.
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
            raise InputError(f"grid = {self.grid!r}: give the number of cells along an edge, at least 6")
        if not (isinstance(self.dt, (int, float)) and math.isfinite(self.dt) and self.dt > 0):
            raise InputError(f"dt = {self.dt!r}: give a positive time step in seconds")
        gravity = tuple(float(g) for g in self.gravity)
        if len(gravity) != 3 or not all(math.isfinite(g) for g in gravity):
            raise InputError(f"gravity = {self.gravity!r}: give three finite accelerations in m/s^2")
        if self.walls not in FORMS:
            raise InputError(f"walls = {self.walls!r} is unknown; choose one of {', '.join(FORMS)}")
        most = (self.grid - 4) // 2 if self.walls == "released" else 1
        if not isinstance(self.wall_cells, int) or not 1 <= self.wall_cells <= most:
            raise InputError(
                f"wall_cells = {self.wall_cells!r}: give a whole number from 1 to {most} with {self.walls} walls on "
                "this grid"
            )
        object.__setattr__(self, "gravity", gravity)
        object.__setattr__(self, "boundary", _six_conditions(self.boundary))

    @property
    def dx(self) -> float:
        """Node spacing [m]."""
        return 1.0 / self.grid

    @property
    def clamps(self) -> bool:
        """Whether particles are moved back to where their stencil exists."""
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
        """Closed interval of coordinates whose three nodes all exist [m]."""
        if self.walls == "released":
            return 0.5 * self.dx, 1.0 - 1.5 * self.dx
        return (0.5 - _OUTSIDE) * self.dx, 1.0 + (_OUTSIDE - 0.5) * self.dx

    @property
    def free_range(self) -> tuple[float, float]:
        """Open interval of coordinates that no wall node influences [m]."""
        if self.walls == "released":
            return (self.wall_cells + 0.5) * self.dx, 1.0 - (self.wall_cells + 1.5) * self.dx
        return 0.5 * self.dx, 1.0 - 0.5 * self.dx

    def courant(self, law: Law, rho: float) -> float:
        """Courant number c dt / dx for the wave speed of the law at F = I and a density rho [kg/m^3]."""
        return law.wave_speed(rho) * self.dt / self.dx

    def check_courant(self, law: Law, rho: float) -> float:
        """Courant number of the law.

        Raises:
            InputError: above `COURANT_LIMIT`; names the largest stable time step.
        """
        number = self.courant(law, rho)
        if not number <= COURANT_LIMIT:
            stable = self.dt * COURANT_LIMIT / number
            raise InputError(
                f"law {law.name!r} has Courant number {number:.3g} > {COURANT_LIMIT} on a {self.grid}^3 "
                f"grid with dt = {self.dt:g} s: the largest stable step is dt = {stable:.3g} s"
            )
        return number


@dataclass(frozen=True)
class Body:
    """Particles ``start`` to ``stop`` (excluded) follow ``law``."""

    law: Law
    start: int
    stop: int


def law_weights(law: Law, dtype: torch.dtype) -> tuple[Weights, Weights]:
    """Weights of a law's elasticity and plasticity in the precision of a simulation."""
    elastic, plastic = law.weights()
    return tuple(w.to(dtype) for w in elastic), tuple(w.to(dtype) for w in plastic)


def as_bodies(law: Law | Sequence[Body], count: int) -> tuple[Body, ...]:
    """Bodies that cover `count` particles in order, each particle once; one law alone moves all of them.

    Raises:
        InputError: the ranges overlap, leave a gap, or do not end at `count`.
    """
    if isinstance(law, Law):
        return (Body(law, 0, count),)
    bodies = tuple(law)
    expected = 0
    for body in bodies:
        if body.start != expected or body.stop <= body.start:
            raise InputError(
                f"body {body.law.name!r} has particles {body.start} to {body.stop}: it must start at "
                f"{expected}, where the one before it ends, and hold at least one particle"
            )
        expected = body.stop
    if expected != count:
        raise InputError(f"the bodies cover particles 0 to {expected}, but there are {count} particles")
    return bodies


def consecutive(laws: Sequence[Law], counts: Sequence[int]) -> tuple[Body, ...]:
    """Bodies of the given particle counts, one after the other, each with its law."""
    ends = list(accumulate(counts))
    return tuple(Body(law, end - n, end) for law, n, end in zip(laws, counts, ends, strict=True))


def contact_clearance(model: MPMModel, x: Tensor) -> Tensor:
    """Smallest distance [m] of particles x (..., N, 3) to the zone that feels a wall; <= 0 in contact."""
    low, high = model.free_range
    return torch.minimum(x - low, high - x).amin(dim=(-2, -1))


def _six_conditions(boundary: str | Mapping[str, str] | Sequence[str]) -> tuple[str, ...]:
    """Condition of each wall in the order of `WALLS`."""
    if isinstance(boundary, str):
        conditions = (boundary,) * 6
    elif isinstance(boundary, Mapping):
        unknown = sorted(set(boundary) - set(WALLS))
        if unknown:
            raise InputError(f"boundary: unknown wall {unknown[0]!r}; walls are {', '.join(WALLS)}")
        conditions = tuple(boundary.get(wall, "no_slip") for wall in WALLS)
    else:
        conditions = tuple(boundary)
        if len(conditions) != 6:
            raise InputError(f"boundary: give one condition, or one for each of {', '.join(WALLS)}")
    for condition in conditions:
        if condition not in CONDITIONS:
            raise InputError(f"boundary = {condition!r} is unknown; choose one of {', '.join(CONDITIONS)}")
    return conditions
