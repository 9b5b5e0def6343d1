"""Specimens of a test: a beam with a clamped end, which is released, in the cube of the simulation."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from neuma_lib.mechanics.analytic import analytic_law
from neuma_lib.mechanics.catalogue import at_length_scale
from neuma_lib.mechanics.law import Law
from neuma_lib.sim.clamps import Clamp
from neuma_lib.sim.model import MPM
from neuma_lib.sim.state import State

_HELD = 3  # cells of the clamped part
_MARGIN = 4  # cells between the body and the faces of the cube
_GAP = 0.5
"""Distance of the end of the clamp from the node at the root [cells]. `clamps.HELD_SHARE` holds that node up to 0.7
cells, so that the body is held exactly from there on."""
_PER_CELL = 2  # particles along an edge of a cell
_COURANT = 0.7
_NO_VOLUME = 1e-6
"""Volume of a particle of a load, as a share of that of others."""


@dataclass(frozen=True)
class Beam:
    """A beam of rectangular section that is clamped at x = 0 and free at x = length, with y up.

    Attributes:
        length, height, width: along x, y and z [m].
        density: [kg/m^3].
        gravity: acceleration along -y [m/s^2].
        load: mass at the upper edge of the free end [kg], spread over the width.
    """

    length: float
    height: float
    width: float
    density: float
    gravity: float = 9.81
    load: float = 0.0


@dataclass(frozen=True)
class Specimen:
    """A straight beam at rest in the cube, ready to be released.

    Attributes:
        model, start: of the simulation, in which the edge of the cube is 1.
        edge: edge of the cube [m].
        root: centre of the section at the clamp, in the cube, shape (3,).
    """

    model: MPM
    start: State
    edge: float
    root: Tensor

    def law(self, spec: Mapping[str, Any]) -> Law:
        """The law of the simulation for constants of the world."""
        return analytic_law(at_length_scale(spec, 1 / self.edge), self.model.dt)

    def to_world(self, x: Tensor) -> Tensor:
        """Coordinates of the beam [m] of points (..., 3) in the cube."""
        return (x - self.root.to(x)) * self.edge


def clamped_beam(
    beam: Beam, spec: Mapping[str, Any], cells: int, dtype: torch.dtype = torch.float32
) -> Specimen:
    """The beam on a grid with some cells along its height.

    The end of the clamp is `_GAP` before a node, and that node is the root. Depending on where nodes are, the body
    would otherwise move as if it were up to 0.7 cells longer or shorter. The cube holds the beam in any direction
    between along x and hanging straight down.

    Args:
        spec: law that sets the time step, with constants of the world.
        cells: cells along the height.
    """
    dx = beam.height / cells
    root = _HELD + _MARGIN
    grid = math.ceil(beam.length / dx) + root + _MARGIN
    edge = grid * dx
    lower = torch.tensor([_MARGIN * dx, edge - (_MARGIN + 2 * cells) * dx, (edge - beam.width) / 2])
    size = torch.tensor([beam.length + _HELD * dx, beam.height, beam.width], dtype=torch.float64)
    counts = [max(1, round(_PER_CELL * float(own) / dx)) for own in size]
    ticks = [(torch.arange(n, dtype=torch.float64) + 0.5) / n for n in counts]
    x = lower + size * torch.cartesian_prod(*ticks)
    vol0 = torch.full((len(x),), float(size.prod()) / len(x), dtype=torch.float64)
    mass = beam.density * vol0
    centre = torch.tensor([root * dx, float(lower[1]) + beam.height / 2, edge / 2], dtype=torch.float64)
    if beam.load:
        edge_of_end = [root * dx + beam.length, float(lower[1]) + beam.height]
        added = torch.tensor([[*edge_of_end, float(z)] for z in ticks[2] * size[2] + lower[2]], dtype=x.dtype)
        x = torch.cat([x, added])
        mass = torch.cat([mass, torch.full((len(added),), beam.load / len(added), dtype=x.dtype)])
        # They carry mass and next to no stress.
        vol0 = torch.cat([vol0, torch.full((len(added),), _NO_VOLUME * float(vol0[0]), dtype=x.dtype)])
    scaled = at_length_scale(spec, 1 / edge)
    dt = 1e-3
    for _ in range(20):  # the stiffness of a viscous part depends on dt
        number = MPM(grid, dt).courant(analytic_law(scaled, dt), beam.density)
        dt *= _COURANT / number
    clamp = Clamp((0.0, 0.0, 0.0), ((root - _GAP) / grid, 1.0, 1.0))
    model = MPM(grid, dt, gravity=(0.0, -beam.gravity / edge, 0.0), clamps=(clamp,))
    start = State(
        (x / edge).to(dtype),
        torch.zeros(3, dtype=dtype),
        (mass / edge**3).to(dtype),
        (vol0 / edge**3).to(dtype),
    )
    return Specimen(model, start, edge, centre / edge)
