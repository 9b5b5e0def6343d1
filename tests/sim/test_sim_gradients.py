"""Gradients of a rollout against finite differences, against the torch twin, and against each other."""

import math
from dataclasses import replace

import pytest
import torch

from benchmarks import torch_simulation
from neuma_lib.sim.memory import MemoryPlan, plan_memory
from neuma_lib.sim.model import MPM, MaterialRegion, contact_clearance
from neuma_lib.sim.rollout import rollout
from neuma_lib.sim.state import State
from tests.support.errors import refused
from tests.support.sim_scenes import BOUNDARIES, DT, cube, make_law, strained

pytestmark = pytest.mark.core

IN_THE_AIR = MPM(14, DT)
ON_A_FLOOR = MPM(14, DT)
ON_A_STICKY_FLOOR = MPM(
    14, DT, boundary={"y_min": "sticky"}, contact="nodes"
)  # stops its nodes always: no switch
ON_A_RELEASED_FLOOR = MPM(14, DT, boundary={"y_min": "sticky"}, contact="released")
TOUCHING = 0.12  # height [m] at which the cube of `scene` is in the floor
COUNT = 60
MOTION = ("x", "v", "F", "C")


def scene(centre_y=0.5, **options):
    """A strained, moving cube."""
    x, mass, vol0 = cube(**{"count": COUNT, "side": 0.25, "centre": (0.5, centre_y, 0.5), **options})
    v, F, C = strained(x)
    return State(x, v, mass, vol0, F, C)


def random_loss(states):
    """A fixed random linear function of x, v, F, C and the total F at all frames, with comparable parts."""
    generator = torch.Generator().manual_seed(0)
    value = 0.0
    for values, scale in zip(states, (10.0, 1.0, 1.0, 0.1, 1.0), strict=False):
        weights = torch.randn(values.shape, generator=generator, dtype=torch.float64)
        value = value + scale * (weights.to(values) * values).sum()
    return value


def simulate(model, law, state, frames, **options):
    """States (x, v, F, C) at the frames, and the total F if ``total=True``."""
    path = rollout(model, law, state, steps=frames[-1], frames=frames, **options)
    return path.x, path.v, path.F, path.C, *([] if path.F_total is None else [path.F_total])


def simulate_slowly(model, law, state, frames, total=False, **_):
    """The same by the torch twin."""
    return torch_simulation.rollout(model, law, state, frames, total)


def trainable(law):
    """Parameters of a neural law's networks, which then require gradients. An analytic law has none."""
    parameters = [] if law.elasticity.weights() == () else [*law.elasticity.base, *law.plasticity.base]
    for parameter in parameters:
        parameter.requires_grad_()
    return parameters


def gradients(model, law, state, frames, parameters=(), run=simulate, **options):
    """States at the frames, and gradients of their random loss with respect to x, v, F, C and the parameters."""
    start = {name: getattr(state, name).clone().requires_grad_() for name in MOTION}
    states = run(model, law, replace(state, **start), frames, **options)
    grads = torch.autograd.grad(random_loss(states), [*start.values(), *parameters])
    return [values.detach() for values in states], grads


def assert_near(values, expected, tolerance=1e-9):
    for a, b in zip(values, expected, strict=True):
        assert (a - b).abs().max() < tolerance * b.abs().max()


def assert_equal(values, expected):
    assert all(torch.equal(a, b) for a, b in zip(values, expected, strict=True))


def assert_slopes_match(function, points, grads, sizes):
    """Each gradient against a central difference along a random direction of its input."""
    for index, (point, grad, size) in enumerate(zip(points, grads, sizes, strict=True)):
        generator = torch.Generator().manual_seed(7 + index)
        direction = torch.randn(point.shape, generator=generator, dtype=point.dtype)
        direction *= size / direction.norm()

        def shifted(sign, index=index, direction=direction):
            moved = [p + sign * direction if i == index else p for i, p in enumerate(points)]
            return function(moved)

        difference = float(shifted(1) - shifted(-1)) / 2
        slope = float((grad * direction).sum())
        scale = float(grad.norm() * direction.norm()) / direction.numel() ** 0.5  # of a typical direction
        assert abs(difference - slope) < 1e-6 * max(abs(slope), scale), (index, difference, slope)


def assert_gradients_match(model, law, state, frames, sizes, **options):
    """Gradients with respect to x0, v0, F0, C0 and parameters against differences with steps of given sizes."""
    parameters = trainable(law)
    _, grads = gradients(model, law, state, frames, parameters, **options)

    def value(points):
        with torch.no_grad():
            for parameter, point in zip(parameters, points[4:], strict=True):
                parameter.copy_(point)
            moved = replace(state, **dict(zip(MOTION, points[:4], strict=True)))
            return random_loss(simulate(model, law, moved, frames, **options))

    points = [p.detach().clone() for p in (*(getattr(state, name) for name in MOTION), *parameters)]
    # Plastic weights move F by a thousandth of their change: a larger step exceeds the round-off.
    relative = [1e-5] * 3 + [1e-3] * 3
    steps = [*sizes, *(r * float(p.norm()) for r, p in zip(relative, points[4:], strict=False))]
    assert_slopes_match(value, points, grads, steps)


@pytest.mark.parametrize(
    "model, height",
    [(IN_THE_AIR, 0.5), (ON_A_FLOOR, TOUCHING), (ON_A_STICKY_FLOOR, TOUCHING), (ON_A_RELEASED_FLOOR, 0.2)],
    ids=["air", "floor", "nodes", "released"],
)
@pytest.mark.parametrize("steps", [1, 20])
@pytest.mark.parametrize("name", ["fixed_corotated", "hencky", "neo_hookean", "viscous_flow", "neural"])
def test_finite_differences(name, steps, model, height):
    """One step and twenty, with respect to x0, v0, F0, C0 and the weights, on states without switches."""
    assert_gradients_match(model, make_law(name), scene(height), (steps,), [1e-5, 1e-4, 1e-5, 1e-4])


def falling():
    """An undeformed cube in the air that is in contact with the floor after 40 steps."""
    x, mass, vol0 = cube(COUNT, side=0.25, centre=(0.5, 0.19, 0.5))
    return State(x, torch.tensor([0.3, -2.0, 0.1], dtype=x.dtype).repeat(COUNT, 1), mass, vol0)


BOUNCE = [1e-6, 1e-6, 1e-6, 1e-5]
"""Steps of differences. C moves particles by a time step of itself: a larger step stands out of the round-off."""


@pytest.mark.parametrize("contact, boundary", BOUNDARIES)
def test_finite_differences_through_a_bounce(contact, boundary):
    """From free flight to the way back, with respect to x0, v0, F0 and C0; contacts start and stop on the way."""
    model, law, frames = MPM(14, DT, boundary=boundary, contact=contact), make_law("hencky"), (0, 40, 100)
    path, vol0 = simulate(model, law, falling(), frames), falling().vol0
    assert contact_clearance(model, path[0][0], vol0) > 0 > contact_clearance(model, path[0][1], vol0)
    assert boundary == "sticky" or path[1][2, :, 1].mean() > 0.5
    assert_gradients_match(model, law, falling(), frames, BOUNCE)


@pytest.mark.parametrize("name, factor", [("von_mises", 1), ("viscous_flow", 10)])
def test_finite_differences_of_the_total_deformation_where_a_body_flows(name, factor):
    """Through contact and plastic flow, where the total deformation differs from the elastic one.

    A law without a yield point has no switches, so that a larger step can stand out of the round-off.
    """
    model, law, frames = MPM(14, DT), make_law(name), (0, 40, 100)
    x, _, F, _, F_total = simulate(model, law, falling(), frames, total=True)
    vol0 = falling().vol0
    assert contact_clearance(model, x[0], vol0) > 0 > contact_clearance(model, x[1], vol0)
    assert (F_total[2] - F[2]).abs().max() > 0.1
    assert_gradients_match(model, law, falling(), frames, [factor * size for size in BOUNCE], total=True)


CONTACTS = [("nodes", False), ("released", False), ("nodes", True), ("particles", True)]


def corner(contact):
    """A model whose walls differ, and a cube in the corner where three of them meet."""
    boundary = {"y_min": "no_slip", "x_min": "slip"}
    if contact != "particles":
        boundary["z_min"] = "sticky"
    thickness = {"wall_cells": 2} if contact == "released" else {}
    model = MPM(14, DT, boundary=boundary, contact=contact, **thickness)
    return model, scene(centre=3 * (0.22 if contact == "released" else TOUCHING,))


@pytest.mark.parametrize("contact, total", CONTACTS)
@pytest.mark.parametrize("cache_bytes", [0, math.inf])
@pytest.mark.parametrize("name", ["von_mises", "drucker_prager", "fluid", "neural"])
def test_equals_torch_twin(name, cache_bytes, contact, total):
    """States and gradients of 15 steps, at walls of every kind and with plastic flow, to 1e-9.

    The total deformation starts from an elastic one, and is recomputed too if memory is limited.
    """
    model, start = corner(contact)
    law, frames = make_law(name), (0, 4, 15)
    parameters = trainable(law)
    expected = gradients(model, law, start, frames, parameters, run=simulate_slowly, total=total)
    for limit in ({}, {"memory": 8.4e5}) if total else ({},):
        options = dict(cache_bytes=cache_bytes, total=total, **limit)
        for values, twin in zip(
            gradients(model, law, start, frames, parameters, **options), expected, strict=True
        ):
            assert_near(values, twin)


def test_total_deformation_changes_no_other_value():
    """States, and gradients of a loss that does not read it, are the same bytes."""
    start, law, model, frames = scene(TOUCHING), make_law("von_mises"), MPM(14, DT), (0, 3, 12)

    def elastic_states(*arguments, **options):
        states = simulate(*arguments, **options)
        assert len(states) == 4 + options["total"]
        return states[:4]

    for options in ({}, {"cache_bytes": 0}):
        without, with_total = (
            gradients(model, law, start, frames, run=elastic_states, total=total, **options)
            for total in (False, True)
        )
        assert_equal([*without[0], *without[1]], [*with_total[0], *with_total[1]])


def test_pressed_against_the_end_of_the_grid():
    """Particles that the released walls clamp where the stencil ends: states and gradients of the torch twin."""
    model = MPM(14, 2e-3, boundary="slip", contact="released")
    start = scene(0.18, side=0.2)
    start = replace(start, v=torch.tensor([0.3, -8.0, 0.1], dtype=start.x.dtype).repeat(COUNT, 1))
    law, frames = make_law("drucker_prager"), (4, 12)
    states, grads = gradients(model, law, start, frames)
    assert (states[0][-1, :, 1] == model.stencil_range[0]).sum() > 3
    assert_near(grads, gradients(model, law, start, frames, run=simulate_slowly)[1])


@pytest.mark.parametrize("contact", ["particles", "nodes"])
def test_several_bodies_equal_torch_twin(contact):
    """Two bodies in contact, one law used twice and trained: its gradients add up."""
    model, start = corner(contact)
    law, other = make_law("neural"), make_law("hencky")
    parameters = trainable(law)
    bodies = [MaterialRegion(law, 0, 25), MaterialRegion(other, 25, 40), MaterialRegion(law, 40, COUNT)]
    fast, slow = (
        gradients(model, bodies, start, (10,), parameters, run) for run in (simulate, simulate_slowly)
    )
    assert_near(fast[1], slow[1])


def test_cached_values_do_not_change_the_gradient():
    """Everything, nothing but states, and an amount that is spent half-way give the same bytes."""
    start, law, model = scene(TOUCHING), make_law("neural"), MPM(14, DT)
    parameters = trainable(law)
    step_bytes = 8 * (18 + 4) * COUNT + 8 * model.nodes**2
    half_way = 12 * step_bytes + 7 * 2000 * COUNT
    everything, *others = (
        gradients(model, law, start, (3, 12), parameters, cache_bytes=cache_bytes)[1]
        for cache_bytes in (math.inf, 0, half_way)
    )
    for grads in others:
        assert_equal(grads, everything)


@pytest.mark.parametrize(
    "cache_bytes,segment,total",
    [(0, 5, False), (math.inf, 4, False), (math.inf, 5, False), (0, 5, True), (math.inf, 4, True)],
)
def test_checkpoints_do_not_change_the_gradient(cache_bytes, segment, total):
    """With little memory the steps are computed again, segment by segment: the same bytes, also the second time."""
    start, steps, law = scene(TOUCHING, count=2000), 13, make_law("neural")
    parameters = trainable(law)
    model, frames, N = MPM(9, DT), (0, 3, 7, steps), len(start.x)
    options = dict(cache_bytes=cache_bytes, total=total)
    _, expected = gradients(model, law, start, frames, parameters, **options)
    rows, grids = model.nodes**2, 8 * 12 * model.nodes**3
    state, step = 8 * (36 if total else 27) * N, 8 * (18 + 4) * N + 8 * rows
    states = state * (segment + 1 + math.ceil(steps / segment))
    options["memory"] = states + step * (segment if cache_bytes else 1) + grids + 8 * 9 * N
    plan = plan_memory(steps, N, model.nodes**3, 8, **options, contact=True, rows=rows)
    assert plan == MemoryPlan(segment, cache_bytes > 0, 0)
    loss = random_loss(simulate(model, law, start, frames, **options))
    for _ in range(2):
        grads = torch.autograd.grad(loss, parameters, retain_graph=True)
        assert_equal(grads, expected[-len(grads) :])


@pytest.mark.parametrize("rows", [60, 0])
@pytest.mark.parametrize(("total", "contact"), [(False, False), (True, False), (False, True)])
def test_a_plan_is_the_longest_segment_that_fits(rows, total, contact):
    """Against a list of the sizes of all plans, in the order of preference."""
    steps, N, nodes, item = 13, 100, 500, 4
    state = item * N * (24 + 9 * total + 3 * contact)  # x, v, C, F; F_total; tangential displacement
    step = item * 18 * N  # tau, F_trial
    step += item * 4 * N + 8 * rows if rows else item * 8 * nodes  # touched nodes and their bounds; two grids
    shared = item * (12 * nodes + 9 * N) if rows else 0
    sizes = {(steps, False): state * (steps + 1) + step + shared}  # all states, without checkpoints
    for caches in (True, False):
        for segment in range(steps, 0, -1):
            kept = step * (segment if caches else 1)
            sizes.setdefault(
                (segment, caches), state * (segment + 1 + math.ceil(steps / segment)) + kept + shared
            )
    options = dict(total=total, contact=contact, rows=rows)

    def plan(memory, cache_bytes=math.inf):
        return plan_memory(steps, N, nodes, item, cache_bytes, memory, **options)

    whole = sizes.pop((steps, False))
    for memory in sorted({*sizes.values(), *(size - 1 for size in sizes.values())}):
        if min(sizes.values()) <= memory < whole:
            expected = next(key for key, size in sizes.items() if size <= memory)
            assert plan(memory) == MemoryPlan(*expected, 0)
    assert plan(whole) == MemoryPlan(steps, False, 0)
    assert plan(whole + steps * step + 7) == MemoryPlan(steps, True, 7)
    assert plan(None, steps * step - 1) == MemoryPlan(steps, False, 0)
    assert plan(None, steps * step) == MemoryPlan(steps, True, 0) and plan(None, 0) == MemoryPlan(
        steps, False, 0
    )
    least = min(*sizes.values(), whole)
    problem = f"{(least - 1) / 2**30:.3g} GiB must be at least {least / 2**30:.3g} GiB"
    with refused("memory", problem=problem):
        plan(least - 1)


def test_too_little_memory():
    with refused("memory"):
        gradients(MPM(14, DT), make_law("neural"), scene(TOUCHING), (13,), memory=1000)


def test_backward_twice():
    """A graph that is retained can be used again, also after other rollouts."""
    start, law, model = scene(TOUCHING), make_law("neural"), MPM(14, DT)
    parameters = trainable(law)
    loss = random_loss(simulate(model, law, start, (3, 12), cache_bytes=math.inf))
    first = torch.autograd.grad(loss, parameters, retain_graph=True)
    random_loss(simulate(model, law, start, (3, 12))).backward()
    assert_equal(first, torch.autograd.grad(loss, parameters))


def test_frames_add_up():
    """The gradient of a sum over frames is the sum of the gradients of rollouts that end at each frame."""
    start, law, frames = scene(), make_law("hencky"), (0, 2, 9)

    def grad_v(frames):
        v = start.v.clone().requires_grad_()
        states = simulate(IN_THE_AIR, law, replace(start, v=v), frames)
        return torch.autograd.grad((states[0] ** 2).sum() + states[1].sum(), v)[0]

    # Frames one by one: v at frame 0 is the start itself.
    alone = sum(grad_v((n,)) for n in frames)
    torch.testing.assert_close(grad_v(frames), alone, rtol=1e-12, atol=1e-14)


@pytest.mark.parametrize("frames", [(3, 8), (5, 40)], ids=["in flight", "through contact"])
def test_gradient_through_a_skipped_flight(frames):
    """Closed form and simulation have the same gradient with respect to x0, one common v0 and the weights."""
    model, law = MPM(14, 2e-3), make_law("neural")
    x0, mass, vol0 = cube(COUNT, side=0.25, centre=(0.5, 0.2, 0.5))
    parameters = trainable(law)

    def grads(skip):
        x = x0.clone().requires_grad_()
        v = torch.tensor([0.3, -2.0, 0.1], dtype=torch.float64, requires_grad=True)
        options = dict(skip_free_flight=skip, total=True)
        loss = random_loss(simulate(model, law, State(x, v, mass, vol0), frames, **options))
        return torch.autograd.grad(loss, (x, v, *parameters), materialize_grads=True)

    for a, b in zip(grads(True), grads(False), strict=True):
        assert (a - b).abs().max() < 1e-7 * max(1.0, float(b.abs().max()))


def test_float32_gradients_are_those_of_float64():
    start, grads = scene(TOUCHING), {}
    for dtype in (torch.float32, torch.float64):
        law = make_law("neural", dtype)
        values = {name: getattr(start, name).to(dtype) for name in (*MOTION, "mass", "vol0")}
        grads[dtype] = gradients(ON_A_STICKY_FLOOR, law, State(**values), (20,), trainable(law))[1]
    for a, b in zip(grads[torch.float32], grads[torch.float64], strict=True):
        assert (a - b).norm() < 1e-3 * b.norm()


def test_weights_take_the_precision_of_the_particles():
    """A law in float32 simulates particles in float64, and its gradients arrive in float32."""
    law = make_law("neural", torch.float32)
    _, grads = gradients(IN_THE_AIR, law, scene(), (5,), trainable(law))
    assert grads[0].dtype == torch.float64
    assert all(grad.dtype == torch.float32 and grad.abs().max() > 0 for grad in grads[4:])


def test_states_without_a_required_gradient_have_none():
    with torch.no_grad():
        states = simulate(IN_THE_AIR, make_law("neural"), scene(), (5,))
    states = (*states, *simulate(IN_THE_AIR, make_law("hencky"), scene(), (5,)))
    assert not any(values.requires_grad for values in states)
