"""Several rollouts in the same launches: equality with single rollouts, divergence of one, laws without kernels."""

import logging
import math
import threading
from dataclasses import replace

import pytest
import torch

from neuma_lib.errors import NonFiniteError
from neuma_lib.mechanics.analytic import analytic_law
from neuma_lib.mechanics.analytic_kernels import COEFFICIENTS
from neuma_lib.mechanics.elasticity import Hencky
from neuma_lib.mechanics.law import Law
from neuma_lib.mechanics.side_by_side import fusible, side_by_side
from neuma_lib.sim import batch
from neuma_lib.sim.batch import rollout_batch
from neuma_lib.sim.colliders import Collider
from neuma_lib.sim.memory import MemoryPlan
from neuma_lib.sim.model import MPM, MaterialRegion
from neuma_lib.sim.rollout import RolloutFunction, rollout
from neuma_lib.sim.simulation import Simulation, gather_weights
from neuma_lib.sim.state import State
from neuma_lib.threads import use_threads
from tests.support.errors import refused
from tests.support.sim_scenes import DT, SPECS, cube, make_law, moving_cube, strained

pytestmark = pytest.mark.core

MODEL = MPM(16, DT)
FRAMES = (0, 10, 25, 40)
RUN = dict(steps=FRAMES[-1], frames=FRAMES)
PARTS = ("x", "v", "F", "C")
FURTHER = {
    "ogden": {"elasticity": {"name": "ogden", "E": 5e4, "nu": 0.3, "alpha": 6.0}},
    "mooney_rivlin": {"elasticity": {"name": "mooney_rivlin", "E": 5e4, "nu": 0.3, "q": 0.4}},
    "bingham": {
        "elasticity": {"name": "hencky", "E": 5e4, "nu": 0.3},
        "plasticity": {"name": "viscous_flow", "viscosity": 10.0, "yield_stress": 5e2},
    },
    "cohesive": {
        "elasticity": {"name": "hencky", "E": 5e4, "nu": 0.2},
        "plasticity": {"name": "drucker_prager", "friction_angle": 30.0, "cohesion": 0.01},
    },
}
FUSED = {**SPECS, **FURTHER}
UNSTABLE = {"elasticity": {"name": "hencky", "E": 5e8, "nu": 0.3}}


@pytest.fixture(autouse=True)
def copies_share_launches(monkeypatch):
    monkeypatch.setitem(batch.TOGETHER, "cpu", 8)


def law(name, stiffness=1.0):
    spec = {part: dict(values) for part, values in FUSED[name].items()}
    spec["elasticity"]["E"] *= stiffness
    return analytic_law(spec, DT, name)


def falling(dtype=torch.float64, velocity=(0.3, -2.0, 0.1), count=300):
    """A cube just above the floor."""
    return moving_cube(velocity, count=count, centre=(0.5, 0.21, 0.5), dtype=dtype)


def assert_same(a, b, tolerance=0.0):
    assert a.frames == b.frames
    for name in PARTS:
        one, other = getattr(a, name), getattr(b, name)
        if tolerance:
            assert (one - other).abs().max() <= tolerance * (1 + other.abs().max()), name
        else:
            assert torch.equal(one, other), name


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("name", FUSED)
def test_kernels_agree_with_the_laws_themselves(name, dtype):
    """To round-off of the largest value; also where nothing yields, inside out, crushed and at rest."""
    generator = torch.Generator().manual_seed(0)
    noise = torch.randn(37, 3, 3, generator=generator, dtype=torch.float64)
    eye = torch.eye(3, dtype=torch.float64).expand(37, 3, 3)
    flipped = torch.diag(torch.tensor([1.0, 1.0, -1.0], dtype=torch.float64))
    strained = eye + 0.1 * noise
    for F in (eye, eye + 1e-6 * noise, strained, strained @ flipped, 0.03 * eye, 1.2 * eye):
        F = torch.cat([F, 1.01 * F]).to(dtype)
        both = side_by_side([law(name), law(name, 1.7)])
        for part in (both.elasticity, both.plasticity):
            weights = tuple(w.to(dtype) for w in part.weights())
            expected = part.response(F, weights)
            actual = part.evaluate(F, weights, out=torch.full_like(F, torch.nan))
            # Three rotations, an exponential and up to a dozen products; the stress of a strain e has the round-off
            # of F times the stiffness.
            stiffness = 0.0 if part is both.plasticity else 2e5 * F.abs().max() ** 2
            scale = stiffness + expected.abs().max()
            assert (actual - expected).abs().max() <= 32 * torch.finfo(dtype).eps * scale


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_copies_equal_rollouts_of_their_own(dtype):
    """All kinds of laws in one launch; a rollout alone differs by the kernels' round-off, which 40 steps carry on."""
    laws = [law(name, stiffness) for name in FUSED for stiffness in (1.0, 1.3)]
    actual = rollout_batch(MODEL, laws, falling(dtype), **RUN, total=True, together=len(laws))
    for own, path in zip(laws, actual, strict=True):
        alone = rollout(MODEL, own, falling(dtype), **RUN, total=True)
        assert_same(path, alone, 1e4 * torch.finfo(dtype).eps)
        assert (path.F_total - alone.F_total).abs().max() < 1e4 * torch.finfo(dtype).eps
        assert (path.F[-1] - torch.eye(3, dtype=dtype)).abs().max() > 1e-2


def test_number_of_copies_changes_no_bit():
    laws = [law("von_mises", 1 + 0.1 * copy) for copy in range(5)]
    groups = [rollout_batch(MODEL, laws, falling(), **RUN, together=together) for together in (1, 2, 5)]
    for paths in zip(*groups, strict=True):
        assert_same(paths[1], paths[0])
        assert_same(paths[2], paths[0])


def test_divergence_does_not_affect_other_copies(caplog):
    caplog.set_level(logging.INFO)
    laws = [law("hencky"), analytic_law(UNSTABLE), law("von_mises")]
    with pytest.raises(NonFiniteError):
        rollout(MODEL, laws[1], falling(), **RUN)
    first, lost, last = rollout_batch(MODEL, laws, falling(), **RUN)
    assert lost is None and "copy 1 of 3 is left out: rollout: particle" in caplog.text
    for path, own in ((first, laws[0]), (last, laws[2])):
        assert_same(path, rollout_batch(MODEL, [own], falling(), **RUN)[0])
    assert rollout_batch(MODEL, [laws[1]] * 2, falling(), **RUN) == [None, None]


class SlowHencky(Hencky):
    """A law of a user, which torch evaluates."""


class Refusing(SlowHencky):
    """A law whose third evaluation raises an error, which states no copy."""

    count = 0

    def response(self, F, weights):
        Refusing.count += 1
        if Refusing.count % 3 == 0:
            raise NonFiniteError("refusing", "a stress is not finite")
        return super().response(F, weights)


def test_a_law_that_raises_does_not_affect_other_copies(caplog):
    caplog.set_level(logging.INFO)
    laws = [law("hencky"), Law(Refusing(E=5e4, nu=0.3), law("von_mises").plasticity), law("von_mises")]
    first, lost, last = rollout_batch(MODEL, laws, falling(), **RUN)
    assert lost is None and "refusing: a stress is not finite" in caplog.text
    for path, own in ((first, laws[0]), (last, laws[2])):
        assert_same(path, rollout_batch(MODEL, [own], falling(), **RUN)[0])


def test_leaving_the_grid_does_not_affect_other_copies():
    slow, fast = falling(), falling(velocity=(0.0, 100.0, 0.0))
    lost, kept = rollout_batch(MODEL, [law("fluid")] * 2, [fast, slow], **RUN, skip_free_flight=False)
    assert lost is None
    assert_same(kept, rollout_batch(MODEL, [law("fluid")], slow, **RUN, skip_free_flight=False)[0])


def test_every_copy_has_its_own_start():
    """Other velocities, a spin, a strained body; free flight ends for all with the first contact."""
    plain, spin = falling(), State.rigid(*cube(300), velocity=(0.0, -1.0, 0.0), spin=(3.0, 5.0, -2.0))
    sideways = falling(velocity=(2.0, -1.0, -1.0))
    v, F, C = strained(plain.x)
    bent = State(plain.x, v, plain.mass, plain.vol0, F, C)
    for starts in ((plain, sideways), (plain, sideways, spin, bent)):
        laws = [law("von_mises")] * len(starts)
        for start, path in zip(starts, rollout_batch(MODEL, laws, starts, **RUN), strict=True):
            assert_same(path, rollout(MODEL, laws[0], start, **RUN), 1e-9)


def test_a_batch_in_free_flight_needs_no_grid():
    high = replace(falling(), x=falling().x + torch.tensor([0, 0.3, 0]))
    for path in rollout_batch(MODEL, [law("hencky"), law("fluid")], high, **RUN):
        assert_same(path, rollout(MODEL, law("hencky"), high, **RUN))
        assert torch.equal(path.F[-1], torch.eye(3, dtype=torch.float64).expand(300, 3, 3))


def test_laws_without_kernels_share_the_transfers():
    slow = Law(SlowHencky(E=5e4, nu=0.3), law("von_mises").plasticity)
    laws = [make_law("neural"), law("hencky"), slow, law("fluid")]
    assert [fusible(own) for own in laws] == [False, True, False, True]
    for own, path in zip(laws, rollout_batch(MODEL, laws, falling(), **RUN), strict=True):
        assert_same(path, rollout(MODEL, own, falling(), **RUN), 1e-9)


SLIDING = MPM(16, DT, contact="particles", colliders=(Collider("sphere", (0.1,), (0.7, 0.05, 0.5)),))
FRICTIONS = (0.0, 0.2, 0.5, math.inf)


@pytest.mark.parametrize("moves", [False, True])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_every_copy_has_its_own_friction(dtype, moves):
    """The bytes of a batch whose copies all have it. Against a rollout alone, round-off. Rough floors brake more."""
    laws = [law("von_mises", 1 + 0.1 * copy) for copy in range(len(FRICTIONS))]
    sphere = replace(SLIDING.colliders[0], velocity=(0.0, 0.3, 0.0) if moves else (0.0, 0.0, 0.0))
    start = falling(dtype, velocity=(2.0, -1.0, 0.3))
    models = [replace(SLIDING, colliders=(sphere,)).with_friction(mu) for mu in FRICTIONS]
    paths = rollout_batch(models, laws, start, **RUN)
    for copy, (model, own, path) in enumerate(zip(models, laws, paths, strict=True)):
        assert_same(path, rollout_batch(model, laws, start, **RUN)[copy])
        assert_same(path, rollout(model, own, start, **RUN), 1e4 * torch.finfo(dtype).eps)
    along = torch.stack([path.v[-1, :, 0].mean() for path in paths])
    assert (along.diff() < -0.01).all()


def test_coefficients_differ_by_wall():
    """Of two copies with two coefficients, on the floor and a wall."""
    floors = [{"y_min": 0.1, "x_max": 0.7}, {"y_min": 0.7, "x_max": "slip"}]
    models = [MPM(16, DT, contact="particles", boundary=floor) for floor in floors]
    start = moving_cube((3.0, -2.0, 0.5), centre=(0.8, 0.21, 0.5))
    paths = rollout_batch(models, [law("hencky")] * 2, start, **RUN)
    for model, path in zip(models, paths, strict=True):
        assert_same(path, rollout(model, law("hencky"), start, **RUN), 1e-9)
    assert (paths[0].x[-1] - paths[1].x[-1]).abs().max() > 1e-3


def test_models_that_differ_in_more_than_friction_are_refused():
    for models in ([SLIDING], [SLIDING, replace(SLIDING, dt=2 * DT)], [SLIDING, MODEL]):
        with refused("model"):
            rollout_batch(models, [law("hencky")] * 2, falling(), **RUN)


def test_wrong_starts_are_named():
    two = [law("hencky")] * 2
    for laws, start in (([], falling()), (two, [falling()]), (two, [falling(), falling(count=9)])):
        with refused("laws"):
            rollout_batch(MODEL, laws, start, **RUN)


@pytest.mark.parametrize("models", [(MODEL, MODEL), tuple(SLIDING.with_friction(mu) for mu in (0.2, 0.5))])
def test_gradients_of_copies_are_those_of_each(models):
    """The adjoint separates copies as well: same gradients of x and v as of each simulation alone."""
    starts = [falling(), falling(velocity=(1.0, -2.5, 0.5))]
    own = make_law("hencky")

    def gradients(state, *models):
        frictions = [model.frictions for model in models]
        bodies = (MaterialRegion(own, 0, len(state.x)),)
        weights, slices = gather_weights(bodies, state.x.dtype)
        plan = MemoryPlan(FRAMES[-1], True, 0)
        options = dict(plan=plan, copies=len(models), frictions=frictions)
        simulation = Simulation(models[0], bodies, slices, state, FRAMES[-1], **options)
        start = [value.clone().requires_grad_() for value in (*state.motion, state.stuck)]
        x, *_ = RolloutFunction.apply(simulation, FRAMES, None, *start, *weights)
        return torch.autograd.grad(x[-1].square().sum(), start[:2])

    together = gradients(State.joined(starts), *models)
    alone = [gradients(state, model) for state, model in zip(starts, models, strict=True)]
    for actual, expected in zip(together, zip(*alone, strict=True), strict=True):
        assert torch.equal(actual, torch.cat(expected))


def test_constants_are_weights_so_that_graphs_serve_all():
    one, other = side_by_side([law("von_mises")]), side_by_side([law("fluid", 1.3)])
    assert one.plasticity.graph_key() == other.plasticity.graph_key() != one.elasticity.graph_key()
    assert one.elasticity.graph_key() != side_by_side([law("fluid")] * 2).elasticity.graph_key()
    assert one.elasticity.capturable and one.elasticity.weights()[0].shape == (1, 1 + COEFFICIENTS)


@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device")
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("contact", ["nodes", "particles"])
def test_the_gpu_agrees_also_when_it_replays(dtype, contact):
    """Three times, with other constants and friction each time: run, recorded, replayed. One copy diverges in the
    second."""
    for stiffness in (1.0, 1.2, 0.8):
        laws = [law(name, stiffness) for name in FUSED]
        if stiffness == 1.2:
            laws[2] = analytic_law(UNSTABLE)
        start, models = falling(dtype), [MODEL] * len(laws)
        if contact == "particles":
            models = [SLIDING.with_friction(0.1 * copy * stiffness) for copy in range(len(laws))]
        on_gpu = rollout_batch(models, laws, start.to("cuda"), **RUN, total=True)
        on_cpu = rollout_batch(models, laws, start, **RUN, total=True)
        for actual, expected in zip(on_gpu, on_cpu, strict=True):
            assert (actual is None) == (expected is None)
            if actual:
                assert_same(actual.cpu(), expected, 1e4 * torch.finfo(dtype).eps)


@pytest.fixture
def threads():
    """`use_threads`, undone after the test."""
    yield use_threads
    use_threads(1)


@pytest.mark.parametrize("model", [MODEL, SLIDING])
def test_number_of_threads_changes_no_bit(model, threads):
    """Also of new kinds of laws and starts, and where one diverges."""
    laws = [law(name, stiffness) for name in FUSED for stiffness in (1.0, 1.3)]
    laws.insert(3, analytic_law(UNSTABLE))
    run = dict(**RUN, total=True, together=1)
    expected = [rollout_batch(model, [own], falling(), **run)[0] for own in laws]
    assert expected[3] is None
    for count in (1, 2, 3):
        threads(count)
        for one, other in zip(rollout_batch(model, laws, falling(), **run), expected, strict=True):
            assert (one is None) == (other is None)
            if one is not None:
                assert_same(one, other)
                assert torch.equal(one.F_total, other.F_total)


def test_copies_run_at_the_same_time(threads, monkeypatch):
    """Each of two threads waits within its rollout until the other has begun one."""
    both, simulate = threading.Barrier(2, timeout=20), batch.fly_and_simulate
    laws = [law("hencky"), law("von_mises")]
    rollout_batch(MODEL, laws, falling(), **RUN, together=1)  # loads the kernels

    def waiting(*args, **options):
        both.wait()
        return simulate(*args, **options)

    monkeypatch.setattr(batch, "fly_and_simulate", waiting)
    threads(2)
    assert None not in rollout_batch(MODEL, laws, falling(), **RUN, together=1)
