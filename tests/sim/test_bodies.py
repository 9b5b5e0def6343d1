"""Contact of bodies with their own node velocities: against the torch twin, finite differences and closed forms."""

import math
from dataclasses import replace

import pytest
import torch

from benchmarks import torch_simulation
from neuma_lib.mechanics.analytic import analytic_law
from neuma_lib.sim.batch import rollout_batch
from neuma_lib.sim.bodies import Pair
from neuma_lib.sim.model import MPM, consecutive
from neuma_lib.sim.prediction import predict
from neuma_lib.sim.rollout import rollout
from neuma_lib.sim.state import State
from tests.support.contact_scenes import lattice
from tests.support.errors import refused
from tests.support.gradients import check_small_differences
from tests.support.sim_scenes import DENSITY, DT, cube, linear_momentum, loss_of, make_law

pytestmark = pytest.mark.core

GRAVITY = 9.8
FRAMES = (15, 40)
SIZES = (60, 50, 40)
LAWS = ("neo_hookean", "von_mises", "drucker_prager")


def pile(count=2):
    """Spinning cubes of different laws and densities that meet in the air."""
    centres, speeds = [(0.5, 0.3, 0.5), (0.53, 0.5, 0.48), (0.66, 0.42, 0.52)], [0.5, -1.0, 0.0]
    states = []
    for k in range(count):
        x, mass, vol0 = cube(SIZES[k], 0.2, centres[k], seed=k + 1)
        velocity, spin = (0.5 - k, speeds[k], 0.1 * k), (1.0 + k, 2.0 - 3 * k, 3.0)
        states.append(State.rigid(x, (1 + k) * mass, vol0, velocity, spin))
    return State.joined(states, separate=True), consecutive(list(map(make_law, LAWS[:count])), SIZES[:count])


def gradients(model, law, start, **options):
    """States of a rollout, and gradients of a linear function of them with respect to x and v of the start."""
    own = replace(start, x=start.x.clone().requires_grad_(), v=start.v.clone().requires_grad_())
    path = rollout(model, law, own, steps=FRAMES[-1], frames=FRAMES, **options)
    return path, torch.autograd.grad(loss_of(path), (own.x, own.v))


@pytest.mark.parametrize("scatter", ["native", "atomic"])
@pytest.mark.parametrize("count, friction", [(2, 0.3), (2, math.inf), (2, 0.0), (3, 0.2)])
def test_equals_the_torch_twin(count, friction, scatter):
    """States and gradients of 40 steps, in which the bodies touch, if steps are kept and if they are not."""
    start, regions = pile(count)
    model = MPM(14, DT, pairs=(Pair(0, 1, friction),))
    own = replace(start, x=start.x.clone().requires_grad_(), v=start.v.clone().requires_grad_())
    slow = torch_simulation.rollout(model, regions, own, FRAMES)
    for cache_bytes in (0, math.inf):
        path, grads = gradients(model, regions, start, scatter=scatter, cache_bytes=cache_bytes)
        twin = replace(path, **dict(zip(("x", "v", "F", "C"), slow, strict=True)))
        for part in ("x", "v", "F", "C"):
            torch.testing.assert_close(getattr(path, part), getattr(twin, part), rtol=0, atol=1e-10)
        expected = torch.autograd.grad(loss_of(twin), (own.x, own.v), retain_graph=True)
        for one, other in zip(grads, expected, strict=True):
            assert (one - other).abs().max() < 1e-9 * other.abs().max()
    free = rollout(MPM(14, DT), regions, replace(start, bodies=()), steps=40, frames=(40,))
    assert (path.x[-1] - free.x[-1]).abs().max() > 1e-3


def test_branches_belong_to_their_bodies():
    """Bodies with and without a viscous part, whose particles come after those of all bodies.

    The torch twin, which has a viscous part of all laws or none, has a weak one for the body without.
    """
    start, _ = pile(3)
    elasticity = {"name": "hencky", "E": 5e4, "nu": 0.3}

    def laws(weak):
        parts = [(1e-6, 5e-3)] * weak + [(3e4, 5e-3), (2e4, 1e-2)]
        viscous = [{"name": "maxwell", "modulus": modulus, "relaxation": time} for modulus, time in parts]
        without = [analytic_law({"elasticity": elasticity}, DT)] * (not weak)
        return consecutive(
            [*without, *(analytic_law({"elasticity": elasticity, "viscosity": own}, DT) for own in viscous)],
            SIZES,
        )

    model = MPM(14, DT, pairs=(Pair(0, 1, 0.3),))
    path = rollout(model, laws(False), start, steps=40, frames=(40,))
    x, v, *_ = torch_simulation.rollout(model, laws(True), replace(start, F_branch=start.F), (40,))
    torch.testing.assert_close(path.x, x, rtol=0, atol=1e-9)
    torch.testing.assert_close(path.v, v, rtol=0, atol=1e-7)


def test_checkpoints_do_not_change_the_gradient():
    """Segments that are computed again give the same bytes, within the limit of memory."""
    start, regions = pile()
    model = MPM(14, DT, pairs=(Pair(0, 1, 0.3),))
    _, expected = gradients(model, regions, start)
    memory = 3.2e6
    path, actual = gradients(model, regions, start, memory=memory)
    workspace = path.x.grad_fn.simulation.workspace
    assert workspace.size.n_checkpoints > 1
    buffers = (*workspace.states, *workspace.checkpoints, workspace.tau, workspace.F_trial)
    native = workspace.native
    assert sum(buffer.nbytes for buffer in (*buffers, native.kept, native.grids[:, :-1])) <= memory
    for one, other in zip(actual, expected, strict=True):
        assert torch.equal(one, other)


REGIMES = {
    "apart": (0.1, 0.3, -0.02),
    "part": (0.0, 0.3, 0.05),
    "stick": (0.0, 3.0, -0.05),
    "slip": (0.0, 0.1, -0.05),
}


@pytest.mark.parametrize("regime", REGIMES)
def test_gradients_of_each_regime(regime):
    """Differences of three steps in which a block does not touch another, parts from it, sticks to it, or slips."""
    gap, friction, approach = REGIMES[regime]
    model = MPM(14, DT, pairs=(Pair(0, 1, friction),))
    states = []
    for k, (x, mass, vol0) in enumerate(lattice(0.2, 4, (0.5, y, 0.5)) for y in (0.4, 0.6 + gap)):
        x = x + 1e-3 * torch.rand(x.shape, generator=torch.Generator().manual_seed(k), dtype=torch.float64)
        states.append(State(x, k * torch.tensor([0.03, approach, 0.02]).double().expand_as(x), mass, vol0))
    start = State.joined(states, separate=True)
    regions = consecutive([make_law("neo_hookean"), make_law("von_mises")], [64, 64])

    def value(x, v):
        return loss_of(rollout(model, regions, replace(start, x=x, v=v), steps=3, frames=(1, 3)))

    alone = rollout(MPM(14, DT), regions[:1], states[0], steps=3, frames=(3,), skip_free_flight=False).v[0]
    jump = (rollout(model, regions, start, steps=3, frames=(3,)).v[0, :64] - alone).mean(dim=0)
    sliding = math.hypot(float(jump[0]), float(jump[2]))
    assert (jump.abs().max() > 1e-4) == (regime in ("stick", "slip"))
    if regime == "slip":  # more where the normals at the edges are inclined
        assert sliding == pytest.approx(friction * abs(float(jump[1])), rel=0.3)
    check_small_differences(value, (start.x, start.v), 1e-6)


@pytest.mark.parametrize("friction", [0.0, 0.4, math.inf])
def test_momentum_changes_by_the_weight(friction):
    """What one body gains by contact the others lose, to round-off."""
    start, regions = pile(3)
    model = MPM(14, DT, pairs=tuple(Pair(a, b, friction) for a, b in ((0, 1), (0, 2), (1, 2))))
    path = rollout(model, regions, start, steps=60, frames=range(0, 61, 20))
    weight = float(start.mass.sum()) * DT * torch.tensor(model.gravity, dtype=torch.float64)
    for n, v in zip(path.frames, path.v, strict=True):
        expected = linear_momentum(start.mass, start.v) + n * weight
        torch.testing.assert_close(linear_momentum(start.mass, v), expected, rtol=0, atol=1e-12)


def brick(size, spacing, lowest, jitter=0.0):
    """A block on a lattice: positions, masses and volumes. Jitter [spacing] moves the particles of its upper half."""
    x = torch.cartesian_prod(
        *(
            start + spacing * (torch.arange(round(own / spacing)) + 0.5)
            for own, start in zip(size, lowest, strict=True)
        )
    ).double()
    noise = torch.rand(x.shape, generator=torch.Generator().manual_seed(0), dtype=torch.float64) - 0.5
    x = x + jitter * spacing * noise * (x[:, 1:2] > lowest[1] + size[1] / 2)
    vol0 = torch.full((len(x),), spacing**3, dtype=torch.float64)
    return x, DENSITY * vol0, vol0


@pytest.mark.parametrize("friction, angle", [(0.3, 30.0), (0.0, 30.0), (0.8, 30.0), (0.3, 10.0)])
def test_a_block_on_an_inclined_block(friction, angle):
    """It slides with g (sin a - mu cos a), and stays if mu > tan a, as on an inclined plane (`test_contact`).

    Gravity is inclined instead of the blocks. The lower one rests on the floor. The block has 3 cells along an edge.
    """
    a = math.radians(angle)
    spacing, dt = 0.025, 2e-4
    gravity = (GRAVITY * math.sin(a), -GRAVITY * math.cos(a), 0.0)
    model = MPM(16, dt, gravity=gravity, pairs=(Pair(0, 1, friction),))
    base, block = (
        State(x, torch.zeros(3).double(), mass, vol0)
        for x, mass, vol0 in (
            brick((0.9, 0.15, 0.5), spacing, (0.05, 0.0, 0.25), jitter=0.5),
            brick((0.2, 0.2, 0.2), spacing, (0.2, 0.15, 0.4)),
        )
    )
    law = analytic_law({"elasticity": {"name": "neo_hookean", "E": 2e5, "nu": 0.3}}, dt)
    steps = (500, 1500)
    start, upper = State.joined([base, block], separate=True), slice(len(base.x), None)
    path = rollout(model, law, start, steps=steps[-1], frames=steps)
    speed = path.v[:, upper, 0].mean(dim=1)
    measured = float(speed[1] - speed[0]) / (dt * (steps[1] - steps[0]))
    expected = GRAVITY * max(0.0, math.sin(a) - friction * math.cos(a))
    if expected > 0:
        assert abs(measured - expected) < 0.03 * GRAVITY
    else:
        assert abs(float(speed[1])) < 0.03  # m/s, while free sliding would reach 0.5 and 1.5
    sunk = float(block.x[:, 1].mean() - path.x[1, upper, 1].mean())
    assert abs(sunk) < 0.1 * model.dx


def test_bodies_that_part_are_free():
    """Two cubes that touch at the start and move apart do so as each would alone. As one body they stick."""
    states = [
        State(x, torch.tensor([speed, 0.0, 0.0]).double(), mass, vol0)
        for speed, (x, mass, vol0) in zip(
            (-0.5, 0.5), (lattice(0.2, 6, (c, 0.6, 0.5)) for c in (0.4, 0.6)), strict=True
        )
    ]
    law, model = make_law("neo_hookean"), MPM(20, DT)
    start = State.joined(states, separate=True)
    run = dict(steps=60, frames=(60,), skip_free_flight=False)
    path = rollout(model, law, start, **run)
    alone = torch.cat([rollout(model, law, own, **run).x[0] for own in states])
    assert torch.equal(path.x[0], alone)
    stuck = rollout(model, law, replace(start, bodies=()), **run)
    assert (stuck.x[0] - alone).abs().max() > 0.01


def test_a_ball_hits_another():
    """Equal elastic cubes exchange velocities in a central impact, less what becomes vibration.

    They touch where their surfaces meet: the second moves after the first has crossed the distance between them.
    """
    gap, speed = 0.06, 1.0
    model = MPM(24, DT, gravity=(0.0, 0.0, 0.0))
    law = analytic_law({"elasticity": {"name": "neo_hookean", "E": 2e5, "nu": 0.3}}, DT)
    first, second = (
        State(x, torch.tensor([v, 0.0, 0.0]).double(), mass, vol0)
        for v, (x, mass, vol0) in (
            (speed, lattice(0.2, 9, (0.35, 0.5, 0.5))),
            (0.0, lattice(0.2, 9, (0.55 + gap, 0.5, 0.5))),
        )
    )
    start, count = State.joined([first, second], separate=True), len(first.x)
    path = rollout(model, law, start, steps=150, frames=range(151))
    hit = path.v[:, count:, 0].mean(dim=1)
    began = int((hit > 0.02 * speed).nonzero()[0]) * DT
    assert abs(speed * began - gap) < 0.25 * model.dx
    after = [float(path.v[-1, own, 0].mean()) for own in (slice(count), slice(count, None))]
    assert after[0] + after[1] == pytest.approx(speed, abs=1e-9)
    assert after[1] - after[0] > 0.5 * speed


def test_sand_on_jelly():
    """A pile of sand stays on a block of jelly, which carries its weight, and none of it sinks in by a cell."""
    dt = 5e-4
    model = MPM(20, dt, pairs=(Pair(0, 1, 0.5),))
    jelly = State(*_at_rest(brick((0.4, 0.2, 0.4), 0.025, (0.3, 0.0, 0.3))))
    sand = State(*_at_rest(brick((0.2, 0.1, 0.2), 0.025, (0.4, 0.2, 0.4))))
    laws = [
        analytic_law({"elasticity": {"name": "neo_hookean", "E": 5e4, "nu": 0.3}}, dt),
        make_law("drucker_prager"),
    ]
    start = State.joined([jelly, sand], separate=True)
    path = rollout(model, consecutive(laws, start.bodies), start, steps=800, frames=(800,))
    x, top = path.x[0], float(path.x[0, : len(jelly.x), 1].max())
    on_jelly = x[len(jelly.x) :]
    assert float(on_jelly[:, 1].min()) > top - model.dx
    assert float(on_jelly[:, 1].mean()) < 0.25  # it has flowed
    assert path.v[0, :, 1].mean().abs() < 0.02


def _at_rest(block):
    x, mass, vol0 = block
    return x, torch.zeros(3).double(), mass, vol0


@pytest.mark.parametrize("together", [1, 2])
def test_copies_equal_single_rollouts(together):
    """With their own starts and frictions of pairs, one law or a law of each body."""
    start, _ = pile()
    models = [MPM(14, DT, pairs=(Pair(0, 1, mu),)) for mu in (0.1, 0.7)]
    laws = [[make_law(name) for name in LAWS[:2]], make_law("hencky")]
    starts = [start, replace(start, v=0.9 * start.v)]
    run = dict(steps=40, frames=FRAMES)
    paths = rollout_batch(models, laws, starts, together=together, **run)
    for model, law, own, path in zip(
        models, [consecutive(laws[0], SIZES[:2]), laws[1]], starts, paths, strict=True
    ):
        alone = rollout(model, law, own, **run)
        torch.testing.assert_close(path.x, alone.x, rtol=0, atol=1e-12)
    assert (paths[0].x - paths[1].x).abs().max() > 1e-3
    with refused("laws"):
        rollout_batch(models, [laws[0], [make_law("hencky")] * 3], starts, **run)


def test_tracers_follow_their_body():
    """Those on particles stay on them, also where another body is at the same nodes."""
    start, regions = pile()
    picked = torch.cat([torch.arange(0, 60, 6), torch.arange(60, 110, 5)])
    model = MPM(14, DT, pairs=(Pair(0, 1, 0.3),))
    run = dict(steps=60, frames=(30, 60))
    path = rollout(model, regions, start, tracers=start.x[picked], tracer_bodies=(10, 10), **run)
    torch.testing.assert_close(path.tracers, path.x[:, picked], rtol=0, atol=1e-12)
    with refused("tracer_bodies"):
        rollout(model, regions, start, tracers=start.x[picked], tracer_bodies=(10, 9), **run)


def test_predicted_tracers_belong_to_the_nearest_body():
    """In any order."""
    start, regions = pile()
    picked = torch.cat([torch.arange(0, 60, 6), torch.arange(60, 110, 5)])
    picked = picked[torch.randperm(len(picked), generator=torch.Generator().manual_seed(0))]
    model = MPM(14, DT, pairs=(Pair(0, 1, 0.3),))
    path, failure = predict(model, regions, start, (30, 60), start.x[picked])
    assert failure is None
    torch.testing.assert_close(path.tracers, path.x[:, picked], rtol=0, atol=1e-12)


def test_float32_agrees_with_float64():
    start, regions = pile()
    model = MPM(14, DT, pairs=(Pair(0, 1, 0.3),))
    single = State(
        *(getattr(start, part).float() for part in ("x", "v", "mass", "vol0", "F", "C")), bodies=start.bodies
    )
    laws = consecutive([make_law(name, torch.float32) for name in LAWS[:2]], SIZES[:2])
    (path, grads), (exact, exact_grads) = gradients(model, laws, single), gradients(model, regions, start)
    assert path.x.dtype == torch.float32
    assert (path.x - exact.x).abs().max() < 1e-5
    for one, other in zip(grads, exact_grads, strict=True):
        assert (one - other).abs().max() < 1e-2 * other.abs().max()


def test_what_is_refused():
    start, regions = pile()
    run = dict(steps=1, frames=(1,))
    with refused("state.bodies"):
        replace(start, bodies=(60, 49))
    with refused("state.bodies"):
        rollout(MPM(14, DT, contact="nodes"), regions, start, **run)
    with refused("pairs"):
        rollout(MPM(14, DT, pairs=(Pair(0, 2),)), regions, start, **run)
    with refused("pairs"):
        MPM(14, DT, pairs=(Pair(0, 1), Pair(0, 1, 0.2)))
    with refused("pair.friction"):
        Pair(0, 1, -0.1)
    with refused("pair"):
        Pair(1, 1)
