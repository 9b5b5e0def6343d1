"""Clamped particles: against the torch twin, finite differences and closed forms."""

import math
from dataclasses import replace

import pytest
import torch

from benchmarks import torch_simulation
from neuma_lib.mechanics.analytic import analytic_law
from neuma_lib.sim.batch import rollout_batch
from neuma_lib.sim.clamps import Clamp, clamped_particles
from neuma_lib.sim.colliders import Collider
from neuma_lib.sim.model import MPM, as_regions
from neuma_lib.sim.rollout import rollout
from neuma_lib.sim.state import State
from tests.support.errors import refused
from tests.support.settle import settle
from tests.support.sim_scenes import DENSITY, DT, cube, loss_of, make_law, moving_cube, prism, strained

pytestmark = pytest.mark.core

LEFT = Clamp((0.0, 0.0, 0.0), (0.42, 1.0, 1.0))
MOTION = {"velocity": (0.2, -0.1, 0.3), "spin": (1.0, 3.0, -2.0), "centre": (0.4, 0.5, 0.5)}
KEYFRAMES = ((0.0101, (0.4, 0.5, 0.5), (0.1, 0.0, 0.0)), (0.0203, (0.42, 0.51, 0.5), (0.0, 0.2, 0.1)))
CLAMPS = {
    "resting": (LEFT,),
    "moving": (replace(LEFT, **MOTION),),
    "released": (replace(LEFT, **MOTION, release=0.015),),
    "walls": (replace(LEFT, **MOTION, release=0.02),),
    "two": (replace(LEFT, keyframes=KEYFRAMES, release=0.03), Clamp((0.58, 0.0, 0.0), (1.0, 1.0, 1.0))),
}


def clamped_cube(name, count=60, **options):
    """A model with clamps and a floor, and a strained cube that moves and touches the floor."""
    floor = Collider.plane((0.0, 0.36, 0.0), (0.0, 1.0, 0.0), friction=0.3)
    contact = {} if name == "walls" else {"contact": "particles", "colliders": (floor,)}
    model = MPM(14, DT, clamps=CLAMPS[name], **contact, **options)
    x, mass, vol0 = cube(count)
    v, F, C = strained(x, size=0.02)
    return model, State(x, v, mass, vol0, F, C)


@pytest.mark.parametrize("name", CLAMPS)
def test_equals_the_torch_twin(name):
    """States and gradients of 40 steps, also if states are recomputed, and states in single precision."""
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
    single = State(*(getattr(start, key).float() for key in ("x", "v", "mass", "vol0", "F", "C")))
    path = rollout(model, make_law("neo_hookean", torch.float32), single, steps=40, frames=(20, 40))
    torch.testing.assert_close(path.x.double(), slow, rtol=0, atol=2e-5)


@pytest.mark.parametrize("name", CLAMPS)
def test_finite_differences(name):
    """With respect to the state, of free and of clamped particles."""
    model, start = clamped_cube(name)
    law = make_law("neo_hookean")
    clamped = clamped_particles(model.clamps, start.x) >= 0

    def value(parts):
        return loss_of(rollout(model, law, replace(start, **parts), steps=40, frames=(20, 40)))

    parts = {key: getattr(start, key).clone().requires_grad_() for key in "xvFC"}
    grads = torch.autograd.grad(value(parts), tuple(parts.values()))
    for key, grad in zip(parts, grads, strict=True):
        for mask in (clamped, ~clamped):
            direction = torch.randn(grad.shape, generator=torch.Generator().manual_seed(1), dtype=grad.dtype)
            direction[~mask] = 0
            direction *= 1e-5 / direction.norm()
            with torch.no_grad():
                ends = [value(parts | {key: parts[key] + sign * direction}) for sign in (1, -1)]
            difference, slope = float(ends[0] - ends[1]) / 2, float((grad * direction).sum())
            typical = float(grad.norm() * direction.norm()) / direction.numel() ** 0.5
            assert abs(difference - slope) < 1e-5 * max(abs(slope), typical)
    if name in ("resting", "moving"):  # never released: the velocities of clamped particles have no effect
        assert not any(grad[clamped].any() for key, grad in zip(parts, grads, strict=True) if key in "vC")


def test_clamped_particles_follow_the_motion_exactly():
    """Positions and deformation of clamped particles are those of the rigid frame, as are tracers among them."""
    clamp = replace(LEFT, keyframes=KEYFRAMES)
    model, start = clamped_cube("resting", count=400)
    model = replace(model, grid=32, clamps=(clamp,))
    mine, inner = start.x[:, 0] <= 0.42, start.x[:, 0] < 0.42 - 1.5 * model.dx
    path = rollout(
        model, make_law("hencky"), start, steps=30, frames=range(31), tracers=start.x[inner], total=True
    )
    (first, origin) = clamp.pose(0.0)
    for n in range(31):
        axes, centre = clamp.pose(n * DT)
        turn = axes @ first.mT
        placed = centre + (start.x - origin) @ turn.mT
        torch.testing.assert_close(path.x[n, mine], placed[mine], rtol=0, atol=1e-13)
        torch.testing.assert_close(path.tracers[n], placed[inner], rtol=0, atol=1e-13)
        for F in (path.F, path.F_total):
            torch.testing.assert_close(F[n, mine], turn @ start.F[mine], rtol=0, atol=1e-13)
    assert inner.sum() > 15 and float((path.F[-1, ~mine] - start.F[~mine]).abs().max()) > 1e-3


def test_a_release_is_smooth():
    """A body that was clamped as a whole moves on with the momenta of the clamp."""
    velocity, spin, centre = (0.3, 0.5, -0.2), (2.0, 1.0, -3.0), (0.5, 0.5, 0.5)
    clamp = Clamp((0.0,) * 3, (1.0,) * 3, 0.02, centre, velocity=velocity, spin=spin)
    model = MPM(16, DT, gravity=(0.0, 0.0, 0.0), contact="particles", clamps=(clamp,))
    x, mass, vol0 = cube(500)
    start = State(x, torch.zeros(3).double(), mass, vol0)
    path = rollout(model, make_law("neo_hookean"), start, steps=60, frames=(20, 60))
    moved = clamp.pose(20 * DT)[1]
    expected = State.rigid(path.x[0], mass, vol0, velocity, spin, moved)
    # the velocity of a step is the secant of the rotation, which differs by spin^2 dt / 2 times the distance
    assert (path.v[0] - expected.v).norm(dim=1).max() < 14 * DT / 2 * 0.3
    eye = torch.eye(3, dtype=torch.float64)
    F = path.F[0]
    torch.testing.assert_close(F.mT @ F, eye.expand_as(F), rtol=0, atol=1e-12)
    momentum = [(mass[:, None] * v).sum(dim=0) for v in path.v]
    torch.testing.assert_close(momentum[0], momentum[1], rtol=0, atol=1e-10)


def test_copies_of_a_batch_have_their_own_clamped_particles():
    """`rollout_batch` equals single rollouts of starts whose clamped particles differ."""
    model, start = clamped_cube("released")
    starts = [start, replace(start, x=start.x.roll(7, 0) + torch.tensor([0.01, 0.02, 0.0]).double())]
    laws = [make_law("neo_hookean"), make_law("hencky")]
    together = rollout_batch(model, laws, starts, steps=30, frames=(10, 30), together=len(laws))
    assert not torch.equal(*(clamped_particles(model.clamps, own.x) for own in starts))
    for law, own, path in zip(laws, starts, together, strict=True):
        alone = rollout(model, law, own, steps=30, frames=(10, 30))
        torch.testing.assert_close(path.x, alone.x, rtol=0, atol=1e-12)
        torch.testing.assert_close(path.F, alone.F, rtol=0, atol=1e-11)


@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs CUDA")
@pytest.mark.parametrize("scatter", [None, "atomic"])
@pytest.mark.parametrize("name", CLAMPS)
def test_cuda_equals_cpu(name, scatter):
    """States and gradients, direct and as a replayed graph."""
    model, start = clamped_cube(name, count=500)
    law = make_law("neo_hookean")
    results = []
    for device, repeats in (("cpu", 1), ("cuda", 3)):
        for _ in range(repeats):
            own = start.to(device)
            own = replace(own, **{key: getattr(own, key).clone().requires_grad_() for key in "xvFC"})
            path = rollout(model, law, own, steps=40, frames=(20, 40), scatter=scatter)
            grads = torch.autograd.grad(loss_of(path), (own.x, own.v, own.F, own.C))
            results.append((path.x.detach().cpu(), *(grad.cpu() for grad in grads)))
    for other in results[1:]:
        torch.testing.assert_close(other[0], results[0][0], rtol=0, atol=1e-11)
        for a, b in zip(other[1:], results[0][1:], strict=True):
            assert (a - b).abs().max() < 1e-8 * b.abs().max()


GRAVITY = 9.8


@pytest.mark.parametrize("grid", [18, 27])
@pytest.mark.parametrize("offset", [0.1, 0.6])
def test_a_column_hangs_by_its_weight(grid, offset):
    """A column of length L stretches by rho g L^2 / (2 E), and stays at rest when it is settled.

    The tip layer at the distance y from the clamp moves by rho g (L y - y^2 / 2) / E. A clamp acts as if it ended up to
    0.7 cells dx higher or lower, which changes that by rho g L / E times 0.7 dx. Strains are at most rho g L / E, 2 %,
    so that the law, which is not linear, changes it by 2 % at most.
    """
    E, L, width, spacing = 2e5, 0.4, 0.1, 0.02
    top = round(0.7 * grid) / grid + offset / grid
    dt = 0.3 / grid / math.sqrt(E / DENSITY)
    clamp = Clamp((0.0, top, 0.0), (1.0, 1.0, 1.0))
    model = MPM(grid, dt, gravity=(0.0, -GRAVITY, 0.0), contact="particles", clamps=(clamp,))
    law = analytic_law({"elasticity": {"name": "neo_hookean", "E": E, "nu": 0.0}}, dt)
    start = prism((width, L + 0.1, width), spacing, (0.45, top - L, 0.45))
    period = 4 * L / math.sqrt(E / DENSITY) / dt
    settled = settle(model, law, start, tolerance=2e-3, every=int(period / 40), quiet=int(period / 2))
    tip = start.x[:, 1] < top - L + spacing
    y = L - spacing / 2
    stretch = float((start.x - settled.x)[tip, 1].mean())
    unit = DENSITY * GRAVITY / E
    expected = unit * (L * y - y * y / 2)
    assert abs(stretch - expected) < unit * L * 0.7 * model.dx + 0.02 * expected
    assert torch.equal(settled.x[start.x[:, 1] > top], start.x[start.x[:, 1] > top])
    # released at once instead, it would ring with the tip's speed sqrt(2 g stretch) = 0.4 m/s or less
    path = rollout(model, law, settled, steps=int(period), frames=range(0, int(period), int(period / 20)))
    assert path.v.norm(dim=2).max() < 2e-3


@pytest.mark.parametrize("grid", [20, 30])
@pytest.mark.parametrize("offset", [0.1, 0.6])
def test_a_cantilever_bends_as_a_beam(grid, offset):
    """Deflection of Euler-Bernoulli with Timoshenko's shear, if the free length is L +- 0.7 dx (see `HELD_SHARE`).

    The particles at z move by rho g A z^2 (6 L^2 - 4 L z + z^2) / (24 E I) + rho g (L z - z^2 / 2) / (kappa G), with
    I / A = h^2 / 12, G = E / 2 (nu = 0) and kappa = 5 / 6.
    """
    E, L, h, spacing = 1e7, 0.4, 0.1, 0.02
    end = round(0.3 * grid) / grid + offset / grid
    dt = 0.3 / grid / math.sqrt(E / DENSITY)
    clamp = Clamp((0.0, 0.0, 0.0), (end, 1.0, 1.0))
    model = MPM(grid, dt, gravity=(0.0, -GRAVITY, 0.0), contact="particles", clamps=(clamp,))
    law = analytic_law({"elasticity": {"name": "neo_hookean", "E": E, "nu": 0.0}}, dt)
    start = prism((L + 0.1, h, h), spacing, (end - 0.1, 0.5, 0.45))

    def deflection(length):
        z = length - spacing / 2
        bending = 12 * z * z * (6 * length**2 - 4 * length * z + z * z) / (24 * h * h)
        return DENSITY * GRAVITY / E * (bending + (length * z - z * z / 2) * 2 * 6 / 5)

    period = 2 * math.pi / (1.875**2 * math.sqrt(E * h * h / (12 * DENSITY)) / L**2) / dt
    settled = settle(model, law, start, tolerance=2e-3, every=int(period / 40), quiet=int(period / 2))
    tip = start.x[:, 0] > end + L - spacing
    measured = float((start.x - settled.x)[tip, 1].mean())
    assert deflection(L - 0.7 * model.dx) < measured < deflection(L + 0.7 * model.dx)


def test_a_body_that_cannot_rest_is_refused():
    """It falls, or slides off, for as many steps as allowed."""
    model, start = clamped_cube("resting")
    falling = replace(model, clamps=(), colliders=())
    with refused("settle", problem="m/s after 200 steps"):
        settle(falling, make_law("hencky"), start, max_steps=200)


def test_settling_fixes_clamps_and_colliders_in_their_first_pose():
    """A moving clamp, with key frames and a release, holds its particles during the start; they keep their clamp."""
    model, start = clamped_cube("two", gravity=(0.0, -1.0, 0.0))
    settled = settle(model, make_law("neo_hookean"), start, tolerance=0.02, quiet=100)
    clamped = clamped_particles(model.clamps, start.x)
    assert torch.equal(settled.clamp, clamped)
    assert torch.equal(settled.x[clamped >= 0], start.x[clamped >= 0])
    assert not settled.v.any() and (settled.x - start.x).abs().max() > 1e-4


def test_free_flight_is_not_skipped():
    """A clamped body at rest in the air stays there."""
    x, mass, vol0 = cube(200)
    start = State(x, torch.zeros(3).double(), mass, vol0)
    model = MPM(16, DT, contact="particles", clamps=(Clamp((0.0,) * 3, (1.0,) * 3),))
    path = rollout(model, make_law("hencky"), start, steps=20, frames=(20,))
    assert torch.equal(path.x[0], x)


@pytest.mark.parametrize(
    "settings, where",
    [
        (dict(lowest=(0.0, 0.0, 0.0), highest=(1.0, 0.0, 1.0)), "clamp.highest"),
        (dict(lowest=(0.0, 0.0), highest=(1.0, 1.0, 1.0)), "clamp.lowest"),
        (dict(lowest=(0.0, 0.0, math.nan), highest=(1.0, 1.0, 1.0)), "clamp.lowest"),
        (dict(lowest=(0.0,) * 3, highest=(1.0,) * 3, release=0.0), "clamp.release"),
        (dict(lowest=(0.0,) * 3, highest=(1.0,) * 3, keyframes=KEYFRAMES[::-1]), "clamp.keyframes"),
    ],
)
def test_wrong_clamps_are_refused(settings, where):
    with refused(where):
        Clamp(**settings)


def test_a_clamp_without_particles_is_refused():
    model, start = clamped_cube("resting")
    empty = replace(model, clamps=(LEFT, Clamp((0.9, 0.0, 0.0), (1.0, 1.0, 1.0))))
    with refused("clamps[1]"):
        rollout(empty, make_law("hencky"), start, steps=5, frames=(5,))


def test_a_body_without_forces_is_at_rest():
    """With the default tolerance, in as few steps as must be quiet. Its velocity and spin are removed."""
    start, model = moving_cube((0.3, -2.0, 0.1), count=100), MPM(16, DT, gravity=(0.0, 0.0, 0.0))
    settled = settle(model, make_law("hencky"), start, quiet=40, max_steps=120)
    assert not settled.v.any() and not settled.C.any()
    torch.testing.assert_close(settled.x, start.x, rtol=0, atol=1e-12)
