"""Specimens of a test: a body with a clamped end, which is released, in the cube of the simulation."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from neuma_lib.errors import InputError
from neuma_lib.mechanics.analytic import analytic_law
from neuma_lib.mechanics.catalogue import at_length_scale
from neuma_lib.mechanics.law import Law
from neuma_lib.sim.clamps import Clamp
from neuma_lib.sim.equilibrium import Equilibrium
from neuma_lib.sim.hexahedra import Hexahedra
from neuma_lib.sim.model import MPM
from neuma_lib.sim.rollout import rollout
from neuma_lib.sim.state import State

Array = NDArray[np.float64]

_HELD = 3  # cells of the clamped part
_MARGIN = 4  # cells between the body and the faces of the cube
_GAP = 0.5
"""Distance of the end of the clamp from the node at the root [cells]. `clamps.HELD_SHARE` holds that node up to 0.7
cells, so that the body is held exactly from there on."""
_PER_CELL = 2  # particles along an edge of a cell
_COURANT = 0.7
_NO_VOLUME = 1e-6  # volume of a particle of a load, as a share of that of others


@dataclass(frozen=True)
class Beam:
    """A beam of rectangular section that is clamped at x = 0 and free at x = length, with y up."""

    # length, height, width: along x, y and z [m]
    length: float
    height: float
    width: float
    density: float  # [kg/m^3]
    gravity: float = 9.81  # acceleration along -y [m/s^2]
    load: float = 0.0  # mass at the upper edge of the free end [kg], spread over the width

    def mesh(self) -> Hexahedra:
        """Elements of about half the height. Those at x < 0 are clamped."""
        sizes = self.length, self.height, self.width
        counts = [max(1, round(2 * own / self.height)) for own in sizes]
        along = np.linspace(0.0, self.length, counts[0] + 1)
        sides = [np.linspace(-own / 2, own / 2, n + 1) for own, n in zip(sizes[1:], counts[1:], strict=True)]
        return Hexahedra.of_blocks(
            [np.insert(along, 0, -self.length), *sides], np.ones([counts[0] + 1, *counts[1:]], dtype=bool)
        )

    @property
    def clamp(self) -> Clamp:
        """The region that is held."""
        return Clamp((-2 * self.length, -self.height, -self.width), (0.0, self.height, self.width))


@dataclass(frozen=True, eq=False)
class Specimen:
    """A body in the cube, ready to be released."""

    # model, start: of the simulation, in which the edge of the cube is 1
    model: MPM
    start: State
    places: Tensor  # of the particles in the undeformed body [m], shape (N, 3)
    edge: float  # edge of the cube [m]
    turn: Tensor  # from the axes of the body to those of the cube, shape (3, 3)
    origin: Tensor  # centre of the section at the clamp [m], shape (3,)
    root: Tensor  # the same in the cube, shape (3,)

    def law(self, spec: Mapping[str, Any]) -> Law:
        """The law of the simulation for constants of the world."""
        return analytic_law(at_length_scale(spec, 1 / self.edge), self.model.dt)

    def to_world(self, x: Tensor) -> Tensor:
        """Coordinates of the body [m] of points (..., 3) in the cube."""
        return (x - self.root.to(x)) @ self.turn.to(x) * self.edge + self.origin.to(x)


def clamped_beam(
    beam: Beam,
    spec: Mapping[str, Any],
    cells: int,
    dtype: torch.dtype = torch.float32,
    held: tuple[Hexahedra, Equilibrium] | None = None,
) -> Specimen:
    """The beam on a grid with some cells along its height, see `clamped_body`. ``cells``: cells along the height."""
    dx = beam.height / cells
    count = max(1, round(_PER_CELL * beam.width / dx))
    load = None
    if beam.load:
        across = ((np.arange(count) + 0.5) / count - 0.5) * beam.width
        upper_edge = np.column_stack([np.full((count, 2), (beam.length, beam.height / 2)), across])
        load = upper_edge, beam.load
    gravity = (0.0, -beam.gravity, 0.0)
    return clamped_body(beam.mesh(), beam.clamp, beam.density, gravity, spec, dx, load, held, dtype)


def clamped_body(
    body: Hexahedra,
    clamp: Clamp,
    density: float,
    gravity: Sequence[float] | Array,
    spec: Mapping[str, Any],
    dx: float,
    load: tuple[Array, float] | None = None,
    held: tuple[Hexahedra, Equilibrium] | None = None,
    dtype: torch.dtype = torch.float32,
) -> Specimen:
    """A body that is clamped at one end, on a grid.

    The end of the clamp is `_GAP` before a node, and that node is the root. Depending on where nodes are, the body
    would otherwise move as if it were up to 0.7 cells longer or shorter. The cube holds the body in any direction
    between that of its rest and hanging straight down.

    Args:
        body: the undeformed body, of blocks.
        clamp: region of the body that is held. One of its faces crosses the body.
        density: [kg/m^3].
        gravity: acceleration [m/s^2], parallel to an axis of the body, shape (3,).
        spec: law that sets the time step, with constants of the world.
        dx: edge of a cell [m].
        load: points of the body (M, 3) [m] that share a mass [kg].
        held: a mesh of the same body and its equilibrium before the release. None: undeformed.

    Raises:
        InputError: not exactly one face of the clamp crosses the body.
    """
    axes, plane = _clamped_end(body, clamp, gravity)
    gravity = np.asarray(gravity, dtype=np.float64)
    X, volumes = _particles(body, dx)
    local = X @ axes.T
    kept = local[:, 0] > plane - _HELD * dx
    X, volumes, local = X[kept], volumes[kept], local[kept]
    first = (local[:, 0] > plane) & (local[:, 0] < plane + dx)
    section = local[first].min(axis=0) - dx / 4, local[first].max(axis=0) + dx / 4
    origin = np.array([plane, *(section[0] + section[1])[1:] / 2])
    local = local - origin
    root, reach = _HELD + _MARGIN, float(np.linalg.norm(local, axis=1).max())
    along, above = float(local[:, 0].max()), float(local[:, 1].max())
    grid = 2 * _MARGIN + max(_HELD + math.ceil(along / dx), math.ceil((above + reach) / dx)) + 1
    # node at the section's lower face
    lower = grid - _MARGIN - math.ceil((above - local[first][:, 1].min()) / dx)
    edge = grid * dx
    centre = np.array([root * dx, lower * dx + (section[1] - section[0])[1] / 2, edge / 2])
    mass = density * volumes
    if load is not None:
        points, added = load
        X, local = np.concatenate([X, points]), np.concatenate([local, points @ axes.T - origin])
        mass = np.concatenate([mass, np.full(len(points), added / len(points))])
        # They carry mass and next to no stress.
        volumes = np.concatenate([volumes, np.full(len(points), _NO_VOLUME * volumes[0])])
    x, F = centre + local, np.broadcast_to(np.eye(3), (len(X), 3, 3))
    if held is not None:
        mesh, rest = held
        weights, slopes = mesh.at(X)
        x = centre + (weights @ rest.x) @ axes.T - origin
        F = axes @ np.stack([slope @ rest.x for slope in slopes], axis=2) @ axes.T
    scaled, dt = at_length_scale(spec, 1 / edge), 1e-3
    for _ in range(20):  # the stiffness of a viscous part depends on dt
        number = MPM(grid, dt).courant(analytic_law(scaled, dt), density)
        dt *= _COURANT / number
    clamps = (Clamp((0.0, 0.0, 0.0), ((root - _GAP) / grid, 1.0, 1.0)),)
    model = MPM(grid, dt, gravity=tuple(axes @ gravity / edge), clamps=clamps)
    one = torch.from_numpy
    start = State(
        one(x / edge).to(dtype),
        torch.zeros(3, dtype=dtype),
        one(mass / edge**3).to(dtype),
        one(volumes / edge**3).to(dtype),
        one(np.array(F)).to(dtype),
    )
    return Specimen(model, start, one(X), edge, one(axes), one(origin @ axes), one(centre / edge))


def released(specimen: Specimen, law: Law, duration: float, frame: float) -> tuple[Array, Tensor]:
    """Times after the release (T,) [s] and positions (T, N, 3) [m] of particles in the axes of the body.

    Args:
        duration: [s], which the last times exceed.
        frame: interval [s], about.
    """
    dt = specimen.model.dt
    stride = max(1, int(frame / dt))
    steps = stride * (int(duration / dt / stride) + 2)
    frames = range(0, steps + 1, stride)
    with torch.no_grad():
        path = rollout(
            specimen.model, law, specimen.start, steps=steps, frames=frames, skip_free_flight=False
        )
    return dt * np.array(frames), specimen.to_world(path.x.double())


def _particles(body: Hexahedra, dx: float) -> tuple[Array, Array]:
    """Places (N, 3) [m] and volumes (N,) [m^3] of particles, regular in each element."""
    places, volumes = [], []
    for cell in body.cells:
        low, extent = body.nodes[cell[0]], body.nodes[cell[-1]] - body.nodes[cell[0]]
        counts = [max(1, round(float(_PER_CELL * own / dx))) for own in extent]
        ticks = [(np.arange(n) + 0.5) / n for n in counts]
        places.append(low + extent * np.stack(np.meshgrid(*ticks, indexing="ij"), axis=-1).reshape(-1, 3))
        volumes.append(np.full(len(places[-1]), extent.prod() / len(places[-1])))
    return np.concatenate(places), np.concatenate(volumes)


def _clamped_end(body: Hexahedra, clamp: Clamp, gravity: Sequence[float] | Array) -> tuple[Array, float]:
    """Axes along from the clamp, up and sideways in those of the body (3, 3), and the coordinate along of the clamp's
    end. The axis up is opposite to gravity, or any if gravity is along."""
    low, high = body.nodes.min(axis=0), body.nodes.max(axis=0)
    slack = 1e-6 * (high - low).max()
    faces = [
        (k, sign, sign * bound[k])
        for sign, bound in ((1.0, clamp.highest), (-1.0, clamp.lowest))
        for k in range(3)
        if low[k] + slack < bound[k] < high[k] - slack
    ]
    if len(faces) != 1:
        problem = f"{len(faces)} of its faces cross the body"
        raise InputError("clamp", problem, "Give a region that holds one end")
    k, sign, plane = faces[0]
    axes = np.zeros((3, 3))
    axes[0, k] = sign
    others = [j for j in range(3) if j != k]
    up = max(others, key=lambda j: abs(gravity[j]))
    axes[1, up] = -1.0 if gravity[up] > 0 else 1.0
    axes[2] = np.cross(axes[0], axes[1])
    return axes, plane
