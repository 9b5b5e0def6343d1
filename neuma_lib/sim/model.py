"""Constants of a simulation: grid, time step, gravity, walls, and the laws of ranges of particles."""

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import accumulate

import torch
from torch import Tensor

from neuma_lib.errors import InputError
from neuma_lib.mechanics.catalogue import COURANT_LIMIT
from neuma_lib.mechanics.law import Law, Weights
from neuma_lib.sim.bodies import Pair
from neuma_lib.sim.clamps import Clamp
from neuma_lib.sim.colliders import Collider, contact_radius, unit_cube
from neuma_lib.sim.state import State

WALLS = ("x_min", "x_max", "y_min", "y_max", "z_min", "z_max")
CONDITIONS = ("no_slip", "slip", "sticky")
CONTACTS = ("particles", "nodes", "released")
Condition = str | float
"""Condition of a wall: one of `CONDITIONS`, or a Coulomb coefficient."""
_FRICTION = {"no_slip": math.inf, "slip": 0.0}
_NAMED = {friction: name for name, friction in _FRICTION.items()}
_OUTSIDE = 2  # nodes outside the cube at either end of an axis, wall nodes if ``contact`` is "nodes"


@dataclass(frozen=True)
class MPM:
    """Constants of the material point method on the unit cube.

    Nodes lie at integer multiples of dx = 1 / grid. Bodies touch the faces of the cube and other obstacles in one of
    three ways:

    - "particles": contact changes the velocities of the particles that penetrate a collider (`colliders.Collider`).
      It starts where the surface of the body touches.
    - "nodes": nodes outside the cube stop. The first are one cell outside, at -dx and 1 + dx, with a second one behind
      each to complete the stencil of every reachable position. A particle interacts with a wall if its stencil of three
      nodes per axis contains a wall node, so contact starts half a cell inside the cube. A body rests with its lowest
      particles within 0.4 cells of y = 0, soft bodies below it and stiff ones above.
    - "released": as in the authors' code. Nodes are 0 ... grid - 1, of which the first and last ``wall_cells`` stop.
      Contact starts ``wall_cells + 0.5`` cells inside the cube (one more at the far end), and positions are clamped to
      where the stencil exists, 0.5 dx to 1 - 1.5 dx. With one wall cell the clamp permanently creases soft bodies,
      because it does not change their deformation gradients.

    Attributes:
        grid: cells along an edge of the cube.
        dt: time step [s].
        gravity: acceleration [m/s^2], y is up.
        boundary: boundary condition, one name for all walls or one per wall (keys `WALLS`, default "no_slip").
            "no_slip" stops a wall node whose velocity points into the wall, "slip" removes only the component that
            points into the wall, "sticky" always stops wall nodes. For contact of particles it is a Coulomb
            coefficient: a number, or "no_slip" for infinity and "slip" for 0.
        contact: one of `CONTACTS`.
        wall_cells: thickness of released walls [nodes].
        colliders: obstacles in the cube, for contact of particles only.
        clamps: regions whose particles follow a prescribed motion.
        pairs: constants of the contact of bodies (`State.bodies`). Pairs that are not given have those of `Pair`.

    Raises:
        InputError: a value is out of range or unknown.
    """

    grid: int
    dt: float
    gravity: tuple[float, float, float] = (0.0, -9.8, 0.0)
    boundary: Condition | Mapping[str, Condition] | tuple[Condition, ...] = "no_slip"
    contact: str = "particles"
    wall_cells: int = 1
    colliders: tuple[Collider, ...] = ()
    clamps: tuple[Clamp, ...] = ()
    pairs: tuple[Pair, ...] = ()

    def __post_init__(self):
        if not isinstance(self.grid, int) or self.grid < 6:
            raise InputError("grid", f"{self.grid!r} must be an integer of at least 6 cells along an edge")
        if not (isinstance(self.dt, (int, float)) and math.isfinite(self.dt) and self.dt > 0):
            raise InputError("dt", f"{self.dt!r} must be a positive time step [s]")
        gravity = tuple(float(g) for g in self.gravity)
        if len(gravity) != 3 or not all(math.isfinite(g) for g in gravity):
            raise InputError("gravity", f"{self.gravity!r} must be three finite accelerations [m/s^2]")
        if self.contact not in CONTACTS:
            raise InputError("contact", f"{self.contact!r} must be one of {', '.join(CONTACTS)}")
        largest = (self.grid - 4) // 2 if self.contact == "released" else 1
        if not isinstance(self.wall_cells, int) or not 1 <= self.wall_cells <= largest:
            limits = f"1 to {largest} for contact of {self.contact} and {self.grid} cells"
            raise InputError("wall_cells", f"{self.wall_cells!r} must be an integer from {limits}")
        object.__setattr__(self, "gravity", gravity)
        object.__setattr__(self, "boundary", _six_conditions(self.boundary, self.contact))
        object.__setattr__(self, "colliders", tuple(self.colliders))
        object.__setattr__(self, "clamps", tuple(self.clamps))
        object.__setattr__(self, "pairs", tuple(self.pairs))
        named = [(pair.first, pair.second) for pair in self.pairs]
        if len(set(named)) < len(named):
            raise InputError("pairs", f"{named} must name each pair of bodies once")
        if self.contact != "particles" and self.colliders:
            raise InputError("colliders", f"need contact of particles, not of {self.contact}")

    @cached_property
    def obstacles(self) -> tuple[Collider, ...]:
        """Colliders of contact of particles: the six faces of the cube in the order of `WALLS`, then the others."""
        if self.contact != "particles":
            return ()
        conditions = _six_conditions(self.boundary, self.contact)
        frictions = [_FRICTION[own] if isinstance(own, str) else own for own in conditions]
        return (*unit_cube(frictions), *self.colliders)

    @cached_property
    def frictions(self) -> tuple[float, ...]:
        """Coulomb coefficients of the obstacles and then of the pairs of bodies."""
        return tuple(each.friction for each in (*self.obstacles, *self.pairs))

    @cached_property
    def frictionless(self) -> "MPM":
        """The same model for all models that differ only in `frictions`."""
        if self.contact != "particles":
            return self
        pairs = tuple(replace(pair, friction=0.0) for pair in self.pairs)
        return replace(self.with_friction(0.0), pairs=pairs)

    def with_pair_frictions(self, frictions: Sequence[float]) -> "MPM":
        """This model with other Coulomb coefficients of its pairs of bodies."""
        pairs = zip(self.pairs, frictions, strict=True)
        return replace(self, pairs=tuple(replace(pair, friction=own) for pair, own in pairs))

    def with_friction(self, friction: float, given: bool = True) -> "MPM":
        """This model with a Coulomb coefficient of all obstacles, or only of those that stick if not ``given``.

        Raises:
            InputError: contact is not of particles.
        """
        if self.contact != "particles":
            raise InputError("friction", f"needs contact of particles, not of {self.contact}")
        frictions = (obstacle.friction for obstacle in self.obstacles)
        changed = [friction if given or own == math.inf else own for own in frictions]
        colliders = zip(self.colliders, changed[len(WALLS) :], strict=True)
        return replace(
            self,
            boundary=tuple(changed[: len(WALLS)]),
            colliders=tuple(replace(collider, friction=own) for collider, own in colliders),
        )

    @property
    def dx(self) -> float:
        """Node spacing [m]."""
        return 1.0 / self.grid

    @property
    def changes(self) -> bool:
        """Whether colliders or clamps depend on time."""
        released = any(math.isfinite(clamp.release) for clamp in self.clamps)
        return released or any(each.moves for each in (*self.colliders, *self.clamps))

    @property
    def bounds_positions(self) -> bool:
        """Whether positions are clamped to where their stencil exists."""
        return self.contact == "released"

    @property
    def wall_nodes(self) -> int:
        """Wall nodes at either end of an axis."""
        return {"particles": 0, "nodes": _OUTSIDE, "released": self.wall_cells}[self.contact]

    @property
    def first_node(self) -> int:
        """Coordinate of the first node of an axis [dx]."""
        return 0 if self.contact == "released" else -_OUTSIDE

    @property
    def nodes(self) -> int:
        """Nodes along an edge of the grid."""
        return self.grid if self.contact == "released" else self.grid + 1 + 2 * _OUTSIDE

    @property
    def stencil_range(self) -> tuple[float, float]:
        """Closed interval of coordinates at which the stencil exists [m]."""
        if self.contact == "released":
            return 0.5 * self.dx, 1.0 - 1.5 * self.dx
        return (0.5 - _OUTSIDE) * self.dx, 1.0 + (_OUTSIDE - 0.5) * self.dx

    @property
    def free_range(self) -> tuple[float, float]:
        """Open interval of coordinates without wall nodes in the stencil, or in the cube without radii [m]."""
        if self.contact == "particles":
            return 0.0, 1.0
        if self.contact == "released":
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


def model_of_each(model: MPM | Sequence[MPM], count: int) -> list[MPM]:
    """The models of ``count`` simulations, from one for all or one for each. Raises InputError."""
    models = [model] * count if isinstance(model, MPM) else list(model)
    if len(models) != count:
        raise InputError("model", f"{len(models)} models for {count} simulations", "Give one for all")
    return models


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
            problem = f"particles {region.start} to {region.stop} must be a range that starts at {expected}"
            raise InputError(f"region {region.law.name!r}", problem)
        expected = region.stop
    if expected != count:
        raise InputError("regions", f"particles 0 to {expected} must be all of the {count} particles")
    return regions


def consecutive(laws: Sequence[Law], counts: Sequence[int]) -> tuple[MaterialRegion, ...]:
    """Consecutive regions with the given laws and numbers of particles."""
    ends = list(accumulate(counts))
    return tuple(MaterialRegion(law, end - n, end) for law, n, end in zip(laws, counts, ends, strict=True))


def with_fields(state: State, regions: Sequence[MaterialRegion]) -> State:
    """The state of bodies at rest with the factors of the fields of their laws, unless it has factors."""
    if state.stiffness is not None or all(region.law.field is None for region in regions):
        return state
    factors = torch.ones_like(state.mass)
    for region in regions:
        if region.law.field is not None:
            own = slice(region.start, region.stop)
            factors[own] = region.law.field.factors(state.x[own].detach())
    return replace(state, stiffness=factors)


def contact_clearance(model: MPM, x: Tensor, vol0: Tensor, steps: Sequence[int] = (0,)) -> Tensor:
    """Smallest distance [m] to the contact zones of walls and colliders, <= 0 in contact, shape (T, ...).

    Args:
        x: positions [m], shape (T, ..., N, 3), or (..., N, 3) for one step.
        vol0: initial volumes of the particles [m^3], shape (N,) or (..., N).
        steps: time steps of the T states, which matter if colliders move.
    """
    low, high = model.free_range
    nearest = torch.minimum(x - low, high - x).amin(dim=-1)
    if model.contact != "particles":
        return nearest.amin(dim=-1)
    for collider in model.colliders:
        if collider.moves and len(steps) > 1:
            far = [collider.surface(own, n * model.dt)[0] for own, n in zip(x, steps, strict=True)]
            distance = torch.stack(far)
        else:
            distance, _ = collider.surface(x, steps[0] * model.dt)
        nearest = torch.minimum(nearest, distance)
    return (nearest - contact_radius(vol0)).amin(dim=-1)


def _six_conditions(
    boundary: Condition | Mapping[str, Condition] | Sequence[Condition], contact: str
) -> tuple[Condition, ...]:
    """Condition of each wall in the order of `WALLS`. Coefficients that have a name are named."""
    if isinstance(boundary, str) or not isinstance(boundary, Iterable):
        conditions = (boundary,) * 6
    elif isinstance(boundary, Mapping):
        unknown = sorted(set(boundary) - set(WALLS))
        if unknown:
            raise InputError("boundary", f"{unknown[0]!r} must be one of {', '.join(WALLS)}")
        conditions = tuple(boundary.get(wall, "no_slip") for wall in WALLS)
    else:
        conditions = tuple(boundary)
        if len(conditions) != 6:
            problem = f"{len(conditions)} conditions must be one per wall: {', '.join(WALLS)}"
            raise InputError("boundary", problem)
    return tuple(_condition(condition, contact) for condition in conditions)


def _condition(condition: Condition, contact: str) -> Condition:
    """A valid condition for the kind of contact."""
    if isinstance(condition, str):
        if condition not in CONDITIONS:
            problem = f"{condition!r} must be one of {', '.join(CONDITIONS)}, or a Coulomb coefficient"
            raise InputError("boundary", problem)
        if condition == "sticky" and contact == "particles":
            problem = "'sticky' needs contact of nodes"
            raise InputError("boundary", problem, "Use no_slip, slip or a Coulomb coefficient")
        return condition
    if isinstance(condition, bool) or not (isinstance(condition, (int, float)) and condition >= 0):
        raise InputError("boundary", f"the Coulomb coefficient {condition!r} must be a number of at least 0")
    if contact != "particles":
        remedy = f"Use {', '.join(CONDITIONS)}, or contact of particles"
        problem = f"the Coulomb coefficient {condition:g} needs contact of particles, not of {contact}"
        raise InputError("boundary", problem, remedy)
    return _NAMED.get(condition, float(condition))
