"""Contact of particles in every kind of rollout: copies, bodies, tracers, total deformation, precisions, segments."""

import math
from dataclasses import replace

import pytest
import torch

from benchmarks import torch_simulation
from neuma_lib.mechanics.analytic import analytic_law
from neuma_lib.sim.batch import rollout_batch
from neuma_lib.sim.colliders import Collider
from neuma_lib.sim.model import MPM, MaterialRegion, contact_clearance
from neuma_lib.sim.rollout import rollout
from neuma_lib.sim.state import State
from tests.support.contact_scenes import COLLIDERS, SHAPES, falling_on, lattice
from tests.support.gradients import check_small_differences
from tests.support.sim_scenes import DT, loss_of, make_law

pytestmark = pytest.mark.core

FRAMES = (15, 40)
RUN = dict(steps=FRAMES[-1], frames=FRAMES)


def gradients(model, law, start, **options):
    """Loss of a rollout and its gradients with respect to x and v of the start."""
    own = replace(start, x=start.x.clone().requires_grad_(), v=start.v.clone().requires_grad_())
    path = rollout(model, law, own, **RUN, **options)
    return path, torch.autograd.grad(loss_of(path), (own.x, own.v))


def touches(model, path, start):
    """Whether the body is in contact at the last frame."""
    return contact_clearance(model, path.x[-1:], start.vol0, path.frames[-1:]) < 0


@pytest.mark.parametrize("cache_bytes", [0, math.inf])
def test_segments_do_not_change_the_gradient(cache_bytes):
    """States that are computed again from checkpoints, with the displacements that stick, give the same bytes.

    Buffers whose size depends on the number of steps stay within the limit of memory, and use most of it.
    """
    slab = Collider("box", (0.3, 0.1, 0.3), (0.5, 0.2, 0.5), friction=0.3, velocity=(0.1, 0.2, 0.3))
    model = MPM(9, DT, contact="particles", colliders=(slab,))
    start = State.rigid(*lattice(0.3, 11, (0.5, 0.46, 0.5)), (1.0, -2.0, 0.0))
    law, options = make_law("von_mises"), dict(total=True, cache_bytes=cache_bytes, skip_free_flight=False)
    path, expected = gradients(model, law, start, **options)
    assert touches(model, path, start)
    segment, segments = 8, 5
    states, grids = 8 * 36 * (segment + 1 + segments), 8 * 12 * model.nodes**3
    step = 8 * (18 + 4) * len(start.x) + 8 * model.nodes**2
    memory = len(start.x) * (states + 8 * 9) + step * (segment if cache_bytes else 1) + grids
    path, actual = gradients(model, law, start, memory=memory, **options)
    workspace = path.x.grad_fn.simulation.workspace
    assert workspace.size.n_checkpoints == segments
    buffers = (*workspace.states, *workspace.checkpoints)
    native = workspace.native
    buffers += (workspace.tau, workspace.F_trial, native.kept, *native.grids[:, : model.nodes**3])
    assert 0.9 * memory < sum(buffer.nbytes for buffer in buffers) <= memory
    for one, other in zip(actual, expected, strict=True):
        assert torch.equal(one, other)


@pytest.mark.parametrize("name", ["box", "sticking"])
def test_a_rollout_in_two_parts_is_the_whole(name):
    """States and gradients, also if the second part starts inside contact, in stick and in slip."""
    model, start = falling_on(COLLIDERS[name], SHAPES["plane"])
    law = make_law("von_mises")
    whole, expected = gradients(model, law, start, total=False)
    own = replace(start, x=start.x.clone().requires_grad_(), v=start.v.clone().requires_grad_())
    first = rollout(model, law, own, steps=30, frames=(FRAMES[0], 30))
    between = own.after(first)
    assert touches(model, first, start) and between.stuck.any()
    second = rollout(model, law, between, steps=FRAMES[1] - 30, frames=(FRAMES[1] - 30,))
    joined = first.at(FRAMES[:1]).followed_by(second)
    for part in ("x", "v", "F", "C", "stuck"):
        torch.testing.assert_close(getattr(joined, part), getattr(whole, part), rtol=0, atol=1e-12)
    for one, other in zip(torch.autograd.grad(loss_of(joined), (own.x, own.v)), expected, strict=True):
        assert (one - other).abs().max() < 1e-9 * other.abs().max()


@pytest.mark.parametrize("name", ["moving", "sticking"])
def test_copies_equal_single_rollouts(name):
    """Each has its law and its start; free flight ends for all copies with the first contact of any."""
    model, start = falling_on(COLLIDERS[name], SHAPES["plane"])
    lifted = replace(start, x=start.x + 0.01 * torch.tensor([0.0, 1.0, 0.0]).double())
    slow = State(start.x, 0.5 * start.v, start.mass, start.vol0)
    names, starts = ("neo_hookean", "fluid", "neural"), (start, lifted, slow)
    laws = [make_law(name) for name in names]
    together = rollout_batch(model, laws, starts, total=True, together=len(laws), **RUN)
    for law, own, path in zip(laws, starts, together, strict=True):
        alone = rollout(model, law, own, total=True, **RUN)
        assert touches(model, path, own)
        for part in ("x", "v", "F", "F_total"):
            torch.testing.assert_close(getattr(path, part), getattr(alone, part), rtol=1e-9, atol=1e-9)


def test_several_bodies_equal_the_torch_twin():
    """Bodies of two laws, with the total deformation: states and gradients."""
    model, start = falling_on(COLLIDERS["moving"], SHAPES["plane"])
    bodies = [MaterialRegion(make_law("von_mises"), 0, 25), MaterialRegion(make_law("hencky"), 25, 60)]
    path, grads = gradients(model, bodies, start, total=True)
    assert touches(model, path, start)
    own = replace(start, x=start.x.clone().requires_grad_(), v=start.v.clone().requires_grad_())
    slow = torch_simulation.rollout(model, bodies, own, FRAMES, total=True)
    twin = replace(path, **dict(zip(("x", "v", "F", "C", "F_total"), slow, strict=True)))
    for part in ("x", "v", "F", "C", "F_total"):
        torch.testing.assert_close(getattr(path, part), getattr(twin, part), rtol=0, atol=1e-9)
    for one, other in zip(grads, torch.autograd.grad(loss_of(twin), (own.x, own.v)), strict=True):
        assert (one - other).abs().max() < 1e-9 * other.abs().max()


@pytest.mark.parametrize("name", COLLIDERS)
def test_float32_agrees_with_float64(name):
    """To the round-off of a float32, which 40 steps with contact enlarge."""
    model, start = falling_on(COLLIDERS[name], SHAPES["plane"])
    law = make_law("neo_hookean")
    single = State(*(getattr(start, part).float() for part in ("x", "v", "mass", "vol0", "F", "C")))
    (path, grads), (exact, exact_grads) = (gradients(model, law, own) for own in (single, start))
    assert path.x.dtype == torch.float32 and touches(model, exact, start)
    assert (path.x - exact.x).abs().max() < 1e-5
    for one, other in zip(grads, exact_grads, strict=True):
        assert (one - other).abs().max() < 1e-2 * other.abs().max()


@pytest.mark.parametrize("name", ["box", "sphere", "moving"])
def test_no_tracer_passes_through_a_collider(name):
    """Points everywhere in a soft body that falls onto a collider are never deeper in it than 0.25 dx."""
    collider = replace(COLLIDERS[name], friction=1.0)
    model = MPM(16, 5e-4, contact="particles", colliders=(collider,))
    x, mass, vol0 = lattice(0.2, 7, (0.45, 0.55, 0.5))
    inside = torch.rand(500, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64) - 0.5
    tracers = x.mean(dim=0) + 0.2 * inside
    law = analytic_law({"elasticity": {"name": "neo_hookean", "E": 3e4, "nu": 0.3}}, model.dt)
    frames = range(0, 401, 10)
    start = State(x, torch.tensor([0.0, -3.0, 0.0]).double(), mass, vol0)
    path = rollout(model, law, start, steps=400, frames=frames, tracers=tracers)
    depth = [
        -float(collider.surface(own, n * model.dt)[0].min())
        for n, own in zip(frames, path.tracers, strict=True)
    ]
    assert contact_clearance(model, path.x, vol0, frames).min() < 0
    assert max(depth) < 0.25 * model.dx


REGIMES = {"apart": (1e-4, 0.3), "stick": (-1e-4, 3.0), "slip": (-1e-4, 0.02), "damped": (-1e-4, 3.0)}


@pytest.mark.parametrize("moving", [False, True])
@pytest.mark.parametrize("regime", REGIMES)
def test_gradients_of_each_regime(regime, moving):
    """Differences of three steps in which the lowest layer of a block is apart, sticks, slips, or is stopped."""
    gap, friction = REGIMES[regime]
    motion = {"velocity": (0.1, 0.05, 0.2), "spin": (0.2, 1.0, -0.1)} if moving else {}
    slab = Collider(
        "box",
        (0.3, 0.1, 0.3),
        (0.5, 0.3, 0.5),
        friction=friction,
        damping=0.9 * (regime == "damped"),
        **motion,
    )
    model = MPM(14, DT, contact="particles", colliders=(slab,))
    x, mass, vol0 = lattice(0.2, 4, (0.5, 0.5 + gap, 0.5))
    x = x + 1e-5 * torch.rand(x.shape, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    velocity = torch.tensor(slab.velocity) + torch.tensor([0.02, -0.02, 0.01])
    start = State.rigid(x, mass, vol0, velocity, slab.spin, slab.centre)
    start = replace(start, v=start.v.expand_as(x))
    law = make_law("neo_hookean")
    assert states_of(model, start, law) == {regime.replace("damped", "stick")}

    def value(x, v):
        path = rollout(model, law, replace(start, x=x, v=v), steps=3, frames=(1, 3), skip_free_flight=False)
        return loss_of(path)

    check_small_differences(value, (start.x, start.v), 1e-6)


def states_of(model, start, law):
    """Whether the lowest layer is apart, sticks or slips in three steps, by the torch twin."""
    (slab,) = model.colliders
    *now, stuck = *start.motion, torch.zeros_like(start.x)
    lowest = start.x[:, 1] < start.x[:, 1].min() + 1e-3
    regimes = set()
    for n in range(3):
        own = now[0][lowest], now[1][lowest], stuck[lowest], 0.5 * start.vol0[lowest] ** (1 / 3)
        _, s, touching = torch_simulation.touched(slab, *own, model.dt, n * model.dt)
        _, free, _ = torch_simulation.touched(replace(slab, friction=math.inf), *own, model.dt, n * model.dt)
        kinds = torch.where(touching, 1 + ((s - free).norm(dim=1) > 1e-12).int(), 0)
        regimes |= {("apart", "stick", "slip")[kind] for kind in kinds.tolist()}
        regions = [MaterialRegion(law, 0, len(start.x))]
        *now, stuck = torch_simulation.step(model, regions, *now, stuck, start.mass, start.vol0, n * model.dt)
    return regimes
