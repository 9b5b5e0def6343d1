"""Colliders, bodies and motions that the tests of contact share."""

import math
from dataclasses import replace

import torch

from neuma_lib.sim.colliders import Collider
from neuma_lib.sim.model import MPM, contact_clearance
from neuma_lib.sim.state import State
from tests.support.sim_scenes import DENSITY, DT, cube

MOTION = {"velocity": (0.2, 0.5, -0.3), "spin": (1.0, -2.0, 3.0)}
SHAPES = {
    "plane": Collider.plane((0.5, 0.3, 0.5), (0.2, 1.0, -0.1), friction=0.3),
    "box": Collider("box", (0.15, 0.1, 0.2), (0.45, 0.25, 0.5), (0.2, 0.4, -0.1), friction=0.4),
    "sphere": Collider("sphere", (0.15,), (0.4, 0.22, 0.5), friction=0.3, damping=0.3),
    "capsule": Collider("capsule", (0.2, 0.08), (0.5, 0.3, 0.5), (0.0, 0.3, 1.4), friction=0.5),
}
COLLIDERS = {
    **SHAPES,
    "sticking": replace(SHAPES["sphere"], friction=math.inf),
    "frictionless": replace(SHAPES["box"], friction=0.0),
    "moving": replace(SHAPES["box"], **MOTION, damping=0.2),
}


def falling_on(collider, **options):
    """A model with a collider and an inclined plane, and a spinning cube 1 cm above them that slides to the side."""
    model = MPM(14, DT, contact="particles", colliders=(collider, SHAPES["plane"]), **options)
    x, mass, vol0 = cube(60, side=0.2, centre=(0.45, 0.7, 0.5))
    while (clearance := float(contact_clearance(model, x, vol0))) > 0.0101:
        x = x - (clearance - 0.01) * torch.tensor([0.0, 1.0, 0.0]).double()
    velocity, spin = torch.tensor([[1.0, -1.5, 0.3], [3.0, -2.0, 4.0]]).double()
    return model, State.rigid(x, mass, vol0, velocity, spin)


def lattice(side, count, centre):
    """A cube on a regular lattice: positions, masses and volumes."""
    ticks = side * ((torch.arange(count) + 0.5) / count - 0.5).double()
    x = torch.cartesian_prod(ticks, ticks, ticks) + torch.tensor(centre, dtype=torch.float64)
    vol0 = torch.full((len(x),), side**3 / len(x), dtype=torch.float64)
    return x, DENSITY * vol0, vol0


def sphere(radius, spacing, centre=(0.5, 0.5, 0.5)):
    """A sphere on a jittered lattice: positions, masses and volumes. A perfect lattice would have facets.

    Particles are balls of half the spacing, which the surface of the sphere surrounds.
    """
    reach = math.ceil(radius / spacing)
    ticks = spacing * (torch.arange(-reach, reach) + 0.5).double()
    x = torch.cartesian_prod(ticks, ticks, ticks)
    noise = torch.rand(x.shape, generator=torch.Generator().manual_seed(0), dtype=torch.float64) - 0.5
    x = x + 0.5 * spacing * noise
    x = x[x.norm(dim=1) < radius - 0.25 * spacing]
    vol0 = torch.full((len(x),), 4 / 3 * math.pi * radius**3 / len(x), dtype=torch.float64)
    return x + torch.tensor(centre, dtype=torch.float64), DENSITY * vol0, vol0
