"""Transfers on a CPU and loops over a segment, against the kernels of other devices and a loop in Python."""

import math
import os
import signal
import subprocess
import sys
import time
from dataclasses import replace

import pytest
import torch

from neuma_lib.errors import NonFiniteError
from neuma_lib.mechanics.analytic import analytic_law
from neuma_lib.mechanics.neural import neural_law
from neuma_lib.mechanics.structured import structured_law
from neuma_lib.sim import segment_loop, workspace
from neuma_lib.sim.batch import rollout_batch
from neuma_lib.sim.clamps import Clamp
from neuma_lib.sim.model import MPM, MaterialRegion
from neuma_lib.sim.rollout import rollout
from neuma_lib.sim.simulation import Simulation
from neuma_lib.sim.state import State
from tests.support.contact_scenes import COLLIDERS
from tests.support.sim_scenes import DT, SPECS, cube, make_law, strained
from tests.support.structured_laws import specification

pytestmark = pytest.mark.core

TOUCHING = 0.12
MODELS = {
    "particles": MPM(14, DT),
    "obstacles": MPM(14, DT, colliders=(COLLIDERS["moving"], COLLIDERS["sphere"]), boundary=0.4),
    "nodes": MPM(14, DT, contact="nodes", boundary={"y_min": "no_slip", "x_min": "slip", "z_min": "sticky"}),
    "released": MPM(14, DT, contact="released", boundary="slip", wall_cells=2),
    "clamps": MPM(
        14,
        DT,
        clamps=(
            Clamp((0.0, 0.0, 0.0), (0.14, 1.0, 1.0), velocity=(0.5, 0.2, 0.0), spin=(0.0, 0.0, 3.0)),
            Clamp((0.2, 0.0, 0.2), (1.0, 0.15, 1.0), release=10 * DT),
        ),
    ),
}


def falling(contact, dtype=torch.float64, count=100):
    """A strained cube in the corner of the walls."""
    height = 0.28 if contact == "released" else TOUCHING
    x, mass, vol0 = cube(count, 0.25, 3 * (height,))
    v, F, C = strained(x)
    v[:, 1] -= 2.0
    return State(*(value.to(dtype) for value in (x, v, mass, vol0, F, C)))


def run(model, law, start, frames, **options):
    """States and tracers at the frames, and the gradients of a linear function of the states."""
    inputs = {name: getattr(start, name).clone().requires_grad_() for name in ("x", "v", "F", "C")}
    path = rollout(
        model, law, replace(start, **inputs), steps=frames[-1], frames=frames, total=True, **options
    )
    states = [path.x, path.v, path.F, path.C, path.F_total]
    generator = torch.Generator().manual_seed(0)
    loss = sum(
        (torch.randn(values.shape, generator=generator, dtype=torch.float64).to(values) * values).sum()
        for values in states
    )
    grads = torch.autograd.grad(loss, list(inputs.values()))
    tracers = [] if path.tracers is None else [path.tracers]
    return [value.detach() for value in (*states, *tracers)], list(grads)


def assert_near(values, expected, tolerance):
    for one, other in zip(values, expected, strict=True):
        assert (one - other).abs().max() <= tolerance * other.abs().max()


def assert_equal(values, expected):
    assert all(torch.equal(one, other) for one, other in zip(values, expected, strict=True))


@pytest.mark.parametrize("name", ["neo_hookean", "von_mises", "neural"])
@pytest.mark.parametrize("contact", MODELS)
def test_equal_the_kernels_of_other_devices(contact, name):
    """With contact, clamps and tracers, one of which is far from the body, if steps are kept and if they are not."""
    model, law, start, frames = MODELS[contact], make_law(name), falling(contact), (0, 7, 25)
    tracers = torch.cat([start.x[:21] + 0.01, torch.full((1, 3), 0.9, dtype=torch.float64)])
    native = [
        run(model, law, start, frames, tracers=tracers, cache_bytes=cache_bytes)
        for cache_bytes in (0, math.inf)
    ]
    states, grads = run(model, law, start, frames, tracers=tracers, scatter="atomic")
    for own_states, own_grads in native:
        assert_near(own_states, states, 1e-12)
        assert_near(own_grads, grads, 1e-10)
    assert torch.equal(native[0][0][-1][-1, -1], tracers[-1])


@pytest.mark.parametrize("name, tolerance", [("neo_hookean", 1e-5), ("von_mises", 5e-5)])
def test_float32_over_200_steps_of_contact(name, tolerance):
    """Positions to 1e-6 and gradients to 1e-5, or to less than the round-off of float32 where a body flows."""

    def rolled(dtype, **options):
        x, mass, vol0 = cube(1000, 0.3, (0.5, 0.17, 0.5), dtype=dtype)
        v = torch.tensor([0.3, -0.5, 0.1], dtype=dtype).expand_as(x).contiguous()
        return run(MPM(14, DT), make_law(name, dtype), State(x, v, mass, vol0), (200,), **options)

    (states, grads), (_, exact) = rolled(torch.float32), rolled(torch.float64)
    expected, expected_grads = rolled(torch.float32, scatter="atomic")
    assert_near(states[:1], expected[:1], 1e-6)
    assert_near(grads, expected_grads, tolerance)
    for own, other, best in zip(grads, expected_grads, exact, strict=True):
        assert (own - best).norm() < 1.5 * (other - best).norm()


def test_scattered_debris():
    """Particles all over the grid, in no order, and at its ends."""
    model, law = MPM(20, DT, contact="nodes"), make_law("neo_hookean")
    low, high = model.stencil_range
    generator = torch.Generator().manual_seed(2)
    x = low + (high - low) * torch.rand(333, 3, generator=generator, dtype=torch.float64)
    x[:8] = torch.cartesian_prod(*3 * [torch.tensor([low, high])]).double().clamp(low, high)
    _, mass, vol0 = cube(333)
    start = State(x, 0.1 * torch.randn(x.shape, generator=generator, dtype=torch.float64), mass, vol0)
    states, grads = run(model, law, start, (1, 3), skip_free_flight=False)
    expected, expected_grads = run(model, law, start, (1, 3), skip_free_flight=False, scatter="atomic")
    assert_near(states, expected, 1e-12)
    assert_near(grads, expected_grads, 1e-10)


def test_only_touched_nodes_are_not_zero():
    """After a body has moved on, with several copies."""
    start, law = falling("particles", count=50), make_law("neo_hookean")
    lifted = replace(start, x=start.x + torch.tensor([0.0, 0.4, 0.3]).double())
    model = MODELS["particles"]
    workspace.free_pool()
    paths = rollout_batch(
        model, [law, law], [start, lifted], steps=80, frames=(79, 80), skip_free_flight=False, together=2
    )
    (ws,) = workspace._pool
    nodes, expected = model.nodes, torch.zeros(2, *3 * [model.nodes], dtype=torch.bool)
    for copy, path in enumerate(paths):
        base = (path.x[0] / model.dx - model.first_node - 0.5).int()
        for offset in torch.cartesian_prod(*3 * [torch.arange(3)]):
            expected[copy][tuple((base + offset).T)] = True
    touched = (ws.grid_v[0] != 0).any(dim=1)
    assert torch.equal(touched.reshape(2, nodes, nodes, nodes), expected)


@pytest.mark.parametrize("contact", ["obstacles", "clamps"])
@pytest.mark.parametrize("name", ["neo_hookean", "von_mises"])
def test_segments_equal_steps_of_python(contact, name, monkeypatch):
    """The same bytes for any number of steps in a call, for several bodies and copies, and at each repetition.

    Steps of Python compute stresses from F alone, so that those of flowing bodies differ in rounding.
    """
    model, start, frames = MODELS[contact], falling(contact), (0, 3, 20)
    bodies = [MaterialRegion(make_law(name), 0, 37), MaterialRegion(make_law("hencky"), 37, 100)]
    tracers = start.x[:5] + 0.01
    options = [
        dict(tracers=tracers, cache_bytes=cache_bytes, **memory)
        for cache_bytes in (math.inf, 0)
        for memory in ({}, {"memory": 1.2e6})
    ]
    expected = [run(model, bodies, start, frames, **own) for own in options]
    for other in expected[1:]:
        assert_equal([*other[0], *other[1]], [*expected[0][0], *expected[0][1]])
    monkeypatch.setattr(segment_loop, "PARTICLE_STEPS", 3 * len(start.x))
    chunks = run(model, bodies, start, frames, **options[0])
    monkeypatch.setattr(Simulation, "_make_loop", lambda *_: None)
    monkeypatch.setattr(Simulation, "_loop", None, raising=False)
    steps = run(model, bodies, start, frames, **options[0])
    assert_equal([*chunks[0], *chunks[1]], [*expected[0][0], *expected[0][1]])
    if name == "neo_hookean":
        assert_equal([*steps[0], *steps[1]], [*expected[0][0], *expected[0][1]])
    assert_near(steps[0], expected[0][0], 1e-13)
    assert_near(steps[1], expected[0][1], 1e-11)


@pytest.mark.parametrize("learned", ["elasticity", "with return map", "networks"])
def test_segments_of_learned_laws_equal_steps_of_python(learned, monkeypatch):
    """The same bytes of states and gradients, also of the weights, next to an analytic body and for any segments.

    Steps of Python compute stresses of structured laws from F alone, so that they differ in rounding.
    """
    plastic = "von_mises" if learned == "with return map" else None
    law = structured_law(specification(plastic=plastic), dt=DT) if learned != "networks" else neural_law()
    law = law.double()
    law.attach_adaptor(rank=None)
    generator = torch.Generator().manual_seed(4)
    parameters = list(law.parameters())
    for parameter in parameters:
        parameter.data += 0.1 * torch.randn(parameter.shape, generator=generator, dtype=torch.float64)
    parameters = [parameter for parameter in parameters if parameter.requires_grad]
    start, frames = falling("particles"), (0, 3, 20)
    bodies = [MaterialRegion(law, 0, 37), MaterialRegion(make_law("von_mises"), 37, 100)]

    def grads(**options):
        path = rollout(MODELS["particles"], bodies, start, steps=20, frames=frames, **options)
        return [path.x, path.F, *torch.autograd.grad((path.x**2).sum() + path.v.sum(), parameters)]

    options = [{}, {"cache_bytes": 0}, {"memory": 1.2e6}, {"memory": 1.2e6, "cache_bytes": 0}]
    expected = grads()
    assert len(expected) == 2 + (3 if learned == "elasticity" else 6) and all(each.any() for each in expected)
    for own in options:
        assert_equal(grads(**own), expected)
    monkeypatch.setattr(segment_loop, "PARTICLE_STEPS", 3 * len(start.x))
    assert_equal(grads(), expected)
    monkeypatch.setattr(Simulation, "_make_loop", lambda *_: None)
    monkeypatch.setattr(Simulation, "_loop", None, raising=False)
    steps = grads()
    assert_near(steps[:2], expected[:2], 1e-13)
    assert_near(steps[2:], expected[2:], 1e-11)


def test_gradients_of_constants(monkeypatch):
    """Of two bodies of one law, and over several segments, as by the kernels of other devices."""
    model, start = MODELS["particles"], falling("particles")

    def grads(**options):
        E, limit = (torch.tensor(value, dtype=torch.float64, requires_grad=True) for value in (5e4, 5e2))
        spec = {
            "elasticity": {"name": "hencky", "E": E, "nu": 0.3},
            "plasticity": {"name": "von_mises", "E": E, "nu": 0.3, "yield_stress": limit},
        }
        law = analytic_law(spec, dt=DT)
        bodies = [MaterialRegion(law, 0, 37), MaterialRegion(law, 37, 100)]
        path = rollout(model, bodies, start, steps=20, frames=(5, 20), **options)
        return torch.autograd.grad((path.x**2).sum() + path.v.sum(), (E, limit))

    expected = grads(scatter="atomic")
    assert all(grad != 0 for grad in expected)
    for options in ({}, {"cache_bytes": 0}, {"memory": 9.5e5}):
        assert_near(grads(**options), expected, 1e-9)
    monkeypatch.setattr(segment_loop, "PARTICLE_STEPS", 3 * len(start.x))
    assert_near(grads(), expected, 1e-9)


def test_faults_are_reported_with_step_and_particle():
    """As by the kernels of other devices. The next rollout in the same memory is not affected."""
    model, law, start = MPM(14, DT), make_law("neo_hookean"), falling("particles")
    good = run(model, law, start, (20,))
    far = start.v.clone()
    far[41] = torch.tensor([0.0, 0.0, 3000.0])
    bad = [replace(start, v=far), replace(start, F=start.F.index_fill(0, torch.tensor([17]), 1e200))]

    def faults(**options):
        for own in bad:
            with pytest.raises(NonFiniteError) as error:
                run(model, law, own, (20,), **options)
            yield error.value.step, error.value.particle, error.value.happened

    reported = list(faults())
    again = run(model, law, start, (20,))
    assert_equal([*again[0], *again[1]], [*good[0], *good[1]])
    assert list(faults(scatter="atomic")) == reported


@pytest.mark.skipif(sys.platform == "win32", reason="needs a timer")
def test_a_signal_interrupts_a_long_rollout():
    """Within a second, during one of several calls."""
    x, mass, vol0 = cube(5000, 0.3, dtype=torch.float32)
    start, law = State(x, torch.zeros_like(x), mass, vol0), make_law("neo_hookean", torch.float32)
    options = dict(steps=100_000, frames=(100_000,), skip_free_flight=False)
    rollout(MPM(14, DT), law, start, steps=1, frames=(1,), skip_free_flight=False)
    previous = signal.signal(signal.SIGALRM, signal.default_int_handler)
    signal.setitimer(signal.ITIMER_REAL, 0.3)
    begin = time.monotonic()
    try:
        with pytest.raises(KeyboardInterrupt):
            rollout(MPM(14, DT, gravity=(0.0, 0.0, 0.0)), law, start, **options)
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, previous)
    assert time.monotonic() - begin < 1.3


GENERIC = """
import sys
import torch
import warp as wp
wp.config.cpu_compiler_flags = sys.argv[2]
from neuma_lib.sim.model import MPM
from tests.sim.test_transfers import MODELS, falling, make_law, run
states, grads = run(MODELS["obstacles"], make_law("von_mises"), falling("obstacles"), (25,))
torch.save([*states, *grads], sys.argv[1])
"""


@pytest.mark.slow
@pytest.mark.parametrize("flags", ["", "-target-cpu x86-64-v3"], ids=["baseline", "AVX2"])
def test_other_processors(flags, tmp_path):
    """Code for the baseline of the architecture and without AVX-512 has the same results to round-off."""
    if flags and os.uname().machine != "x86_64":
        pytest.skip("needs x86-64")
    states, grads = run(MODELS["obstacles"], make_law("von_mises"), falling("obstacles"), (25,))
    environment = {**os.environ, "NEUMA_KERNEL_CACHE": str(tmp_path / "kernels")}
    result = str(tmp_path / "result.pt")
    subprocess.run([sys.executable, "-c", GENERIC, result, flags], check=True, env=environment)
    assert_near(torch.load(result), [*states, *grads], 1e-9)


def test_laws_of_the_loop():
    """Analytic laws and networks."""
    assert all(make_law(name).elasticity.loops for name in (*SPECS, "neural"))
