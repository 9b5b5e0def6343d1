"""Colliders, bodies and motions that the tests of contact share."""

import math
from dataclasses import replace

import torch

from benchmarks import torch_simulation
from neuma_lib.sim.colliders import Collider
from neuma_lib.sim.model import MPM, as_regions, contact_clearance
from neuma_lib.sim.rollout import rollout
from neuma_lib.sim.state import State
from tests.support.gradients import check_small_differences
from tests.support.sim_scenes import DENSITY, DT, cube, loss_of, make_law

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


def falling_on(*colliders, **options):
    """A model with colliders, and a spinning cube 1 cm above them that slides to the side."""
    model = MPM(14, DT, contact="particles", colliders=colliders, **options)
    x, mass, vol0 = cube(60, side=0.2, centre=(0.45, 0.7, 0.5))
    while (clearance := float(contact_clearance(model, x, vol0))) > 0.0101:
        x = x - (clearance - 0.01) * torch.tensor([0.0, 1.0, 0.0]).double()
    velocity, spin = torch.tensor([[1.0, -1.5, 0.3], [3.0, -2.0, 4.0]]).double()
    return model, State.rigid(x, mass, vol0, velocity, spin)


def assert_equals_twin(model, start):
    """States of 40 steps of contact, and their gradients, are those of the torch twin. Returns its positions."""
    law = make_law("neo_hookean")
    results = []
    for slow in (False, True):
        own = replace(start, x=start.x.clone().requires_grad_(), v=start.v.clone().requires_grad_())
        if slow:
            x, v, F, C = torch_simulation.rollout(model, as_regions(law, 60), own, (20, 40))
            path = replace(results[0][2], x=x, v=v, F=F, C=C)
        else:
            path = rollout(model, law, own, steps=40, frames=(20, 40))
        grads = torch.autograd.grad(loss_of(path), (own.x, own.v))
        results.append((path.x.detach(), grads, path))
    (fast, fast_grads, _), (slow, slow_grads, _) = results
    assert contact_clearance(model, fast, start.vol0, (20, 40)).min() < 0
    torch.testing.assert_close(fast, slow, rtol=0, atol=1e-12)
    for a, b in zip(fast_grads, slow_grads, strict=True):
        assert (a - b).abs().max() < 1e-9 * b.abs().max()
    return slow


def assert_gradient_is_the_difference(model, start):
    """Through first contact, stick and slip, with respect to x0 and v0."""
    law = make_law("neo_hookean")

    def value(x, v):
        return loss_of(rollout(model, law, replace(start, x=x, v=v), steps=60, frames=(30, 60)))

    check_small_differences(value, (start.x, start.v), 1e-5)


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
