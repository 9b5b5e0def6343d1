"""Clamped particles: against the torch twin, finite differences and closed forms."""

from dataclasses import replace

import pytest
import torch

from benchmarks import torch_simulation
from neuma_lib.sim.clamps import Clamp
from neuma_lib.sim.colliders import Collider
from neuma_lib.sim.model import MPM, as_regions
from neuma_lib.sim.rollout import rollout
from neuma_lib.sim.state import State
from tests.support.sim_scenes import DT, cube, make_law, strained

pytestmark = pytest.mark.core

LEFT = Clamp((0.0, 0.0, 0.0), (0.42, 1.0, 1.0))
MOTION = {"velocity": (0.2, -0.1, 0.3), "spin": (1.0, 3.0, -2.0), "centre": (0.4, 0.5, 0.5)}
KEYFRAMES = ((0.0101, (0.4, 0.5, 0.5), (0.1, 0.0, 0.0)), (0.0203, (0.42, 0.51, 0.5), (0.0, 0.2, 0.1)))
CLAMPS = {
    "resting": (LEFT,),
    "moving": (replace(LEFT, **MOTION),),
    "released": (replace(LEFT, **MOTION, release=0.015),),
    "two": (replace(LEFT, keyframes=KEYFRAMES, release=0.03), Clamp((0.58, 0.0, 0.0), (1.0, 1.0, 1.0))),
}


def clamped_cube(name, count=60, **options):
    """A model with clamps and a floor, and a strained cube that moves and touches the floor."""
    floor = Collider.plane((0.0, 0.36, 0.0), (0.0, 1.0, 0.0), friction=0.3)
    model = MPM(14, DT, contact="particles", colliders=(floor,), clamps=CLAMPS[name], **options)
    x, mass, vol0 = cube(count)
    v, F, C = strained(x, size=0.02)
    return model, State(x, v, mass, vol0, F, C)


def loss_of(path):
    generator = torch.Generator().manual_seed(0)
    return sum(
        (torch.randn(value.shape, generator=generator, dtype=value.dtype) * value).sum()
        for value in (10 * path.x, path.v, path.F, 0.1 * path.C)
    )


@pytest.mark.parametrize("name", CLAMPS)
def test_equals_the_torch_twin(name):
    """States and gradients of 40 steps, also if states are recomputed, and gradients of the constants of the law."""
    model, start = clamped_cube(name)
    law = make_law("neo_hookean")
    results = []
    for memory in (None, 1e6, "slow"):
        own = replace(start, **{key: getattr(start, key).clone().requires_grad_() for key in "xvFC"})
        if memory == "slow":
            x, v, F, C = torch_simulation.rollout(model, as_regions(law, 60), own, (20, 40))
            path = replace(results[0][2], x=x, v=v, F=F, C=C)
        else:
            cache = None if memory is None else 0
            path = rollout(model, law, own, steps=40, frames=(20, 40), memory=memory, cache_bytes=cache)
        grads = torch.autograd.grad(loss_of(path), (own.x, own.v, own.F, own.C))
        results.append((path.x.detach(), grads, path))
    slow, slow_grads, _ = results.pop()
    for fast, fast_grads, _ in results:
        torch.testing.assert_close(fast, slow, rtol=0, atol=1e-12)
        for a, b in zip(fast_grads, slow_grads, strict=True):
            assert (a - b).abs().max() < 1e-9 * b.abs().max()
