"""Gradients of a rollout against finite differences, against the torch twin, and against each other."""

import math

import pytest
import torch

from benchmarks import torch_simulation
from neuma_lib.sim.memory import MemoryPlan, plan_memory
from neuma_lib.sim.model import MPM, MaterialRegion, contact_clearance
from neuma_lib.sim.rollout import rollout
from neuma_lib.sim.state import State
from tests.support.errors import refused
from tests.support.sim_scenes import DT, cube, make_law, strained

pytestmark = pytest.mark.core

IN_THE_AIR = MPM(14, DT)
ON_A_STICKY_FLOOR = MPM(14, DT, boundary={"y_min": "sticky"})  # stops its nodes always: no switch
ON_A_RELEASED_FLOOR = MPM(14, DT, boundary={"y_min": "sticky"}, walls="released")
TOUCHING = 0.12
"""Height [m] at which the cube of `scene` is in the floor."""
COUNT = 60


def scene(centre_y=0.5):
    """A strained, moving cube: start (x, v, F, C), mass and volume."""
    x, mass, vol0 = cube(COUNT, side=0.25, centre=(0.5, centre_y, 0.5))
    return (x, *strained(x)), mass, vol0


def random_loss(seed=0):
    """A fixed random linear function of x, v, F, C and the total F at all frames, with comparable parts."""

    def loss(states):
        generator = torch.Generator().manual_seed(seed)
        value = 0.0
        for values, scale in zip(states, (10.0, 1.0, 1.0, 0.1, 1.0), strict=False):
            weights = torch.randn(values.shape, generator=generator, dtype=torch.float64)
            value = value + scale * (weights.to(values) * values).sum()
        return value

    return loss


def simulate(model, law, start, mass, vol0, frames, **options):
    """States (x, v, F, C) at the frames, and the total F if ``total=True``."""
    x, v, F, C = start
    path = rollout(model, law, State(x, v, mass, vol0, F, C), steps=frames[-1], frames=frames, **options)
    return path.x, path.v, path.F, path.C, *([] if path.F_total is None else [path.F_total])


def simulate_slowly(model, law, start, mass, vol0, frames, total=False):
    """The same by the torch twin."""
    x, v, F, C = start
    return torch_simulation.rollout(model, law, State(x, v, mass, vol0, F, C), frames, total)


def trainable(law):
    """Parameters of a neural law's networks, made to require gradients."""
    parameters = [*law.elasticity.base, *law.plasticity.base]
    for parameter in parameters:
        parameter.requires_grad_()
    return parameters


def gradients(model, law, start, mass, vol0, frames, parameters=(), run=simulate, **options):
    """Loss and its gradients with respect to x, v, F, C and the parameters."""
    start = tuple(value.clone().requires_grad_() for value in start)
    loss = random_loss()(run(model, law, start, mass, vol0, frames, **options))
    return loss.detach(), torch.autograd.grad(loss, [*start, *parameters])


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


@pytest.mark.parametrize(
    "model, height",
    [(IN_THE_AIR, 0.5), (ON_A_STICKY_FLOOR, TOUCHING), (ON_A_RELEASED_FLOOR, 0.2)],
    ids=["air", "floor", "released"],
)
@pytest.mark.parametrize("steps", [1, 20])
@pytest.mark.parametrize("name", ["fixed_corotated", "hencky", "neo_hookean", "viscous_flow", "neural"])
def test_finite_differences(name, steps, model, height):
    """One step and twenty, with respect to x0, v0, F0, C0 and the weights, on states without switches."""
    start, mass, vol0 = scene(height)
    law = make_law(name)
    parameters = trainable(law) if name == "neural" else []
    _, grads = gradients(model, law, start, mass, vol0, (steps,), parameters)

    def value(points):
        with torch.no_grad():
            for parameter, point in zip(parameters, points[4:], strict=True):
                parameter.copy_(point)
            return random_loss()(simulate(model, law, points[:4], mass, vol0, (steps,)))

    points = [p.detach().clone() for p in (*start, *parameters)]
    # Plastic weights move F by a thousandth of their own change: a larger step stands out of the round-off.
    relative = [1e-5] * 3 + [1e-3] * 3
    sizes = [1e-5, 1e-4, 1e-5, 1e-4]
    sizes += [r * float(p.norm()) for r, p in zip(relative, points[4:], strict=False)]
    assert_slopes_match(value, points, grads, sizes)


def falling():
    """An undeformed cube in the air that has met the floor after 40 steps: start (x, v, F, C), mass and volume."""
    x, mass, vol0 = cube(COUNT, side=0.25, centre=(0.5, 0.19, 0.5))
    v = torch.tensor([0.3, -2.0, 0.1], dtype=x.dtype).repeat(COUNT, 1)
    at_rest = torch.eye(3, dtype=x.dtype).repeat(COUNT, 1, 1), torch.zeros(COUNT, 3, 3, dtype=x.dtype)
    return (x, v, *at_rest), mass, vol0


def assert_gradients_match(model, law, start, mass, vol0, frames, size=1e-6, **options):
    """Gradients with respect to x0, v0, F0 and C0 against finite differences of a step size."""
    _, grads = gradients(model, law, start, mass, vol0, frames, **options)

    def value(points):
        return random_loss()(simulate(model, law, points, mass, vol0, frames, **options))

    # C moves particles by a time step of itself: a larger step stands out of the round-off.
    assert_slopes_match(value, list(start), grads, [size] * 3 + [10 * size])


@pytest.mark.parametrize("boundary", ["no_slip", "slip", "sticky"])
def test_finite_differences_through_a_bounce(boundary):
    """From free flight to the way back, with respect to x0, v0, F0 and C0; nodes start and stop on the way."""
    start, mass, vol0 = falling()
    model, law, frames = MPM(14, DT, boundary=boundary), make_law("hencky"), (0, 40, 100)
    path = simulate(model, law, start, mass, vol0, frames)
    assert contact_clearance(model, path[0][0]) > 0 > contact_clearance(model, path[0][1])
    assert boundary == "sticky" or path[1][2, :, 1].mean() > 0.5
    assert_gradients_match(model, law, start, mass, vol0, frames)


@pytest.mark.parametrize("name, size", [("von_mises", 1e-6), ("viscous_flow", 1e-5)])
def test_finite_differences_of_the_total_deformation_where_a_body_flows(name, size):
    """Through contact and plastic flow, where the total deformation is another than the elastic one.

    A law without a yield point has no switches, so that a larger step can stand out of the round-off.
    """
    start, mass, vol0 = falling()
    model, law, frames = MPM(14, DT), make_law(name), (0, 40, 100)
    x, _, F, _, F_total = simulate(model, law, start, mass, vol0, frames, total=True)
    assert contact_clearance(model, x[0]) > 0 > contact_clearance(model, x[1])
    assert (F_total[2] - F[2]).abs().max() > 0.1
    assert_gradients_match(model, law, start, mass, vol0, frames, size, total=True)


@pytest.mark.parametrize("cache_bytes", [0, math.inf])
@pytest.mark.parametrize("name", ["von_mises", "drucker_prager", "neural"])
def test_total_deformation_equals_torch_twin(name, cache_bytes):
    """All states and gradients of 15 steps in a corner, from a start that is strained already, to 1e-9."""
    model, start, mass, vol0 = corner()
    law, frames = make_law(name), (0, 4, 15)
    parameters = trainable(law) if name == "neural" else []

    states = simulate(model, law, start, mass, vol0, frames, total=True)
    expected = simulate_slowly(model, law, start, mass, vol0, frames, total=True)
    for a, b in zip(states, expected, strict=True):
        assert (a - b).abs().max() < 1e-9 * b.abs().max()
    for options in ({}, {"memory": 6.2e5}):
        options |= {"cache_bytes": cache_bytes, "total": True}
        _, grads = gradients(model, law, start, mass, vol0, frames, parameters, **options)
        run = dict(run=simulate_slowly, total=True)
        _, expected = gradients(model, law, start, mass, vol0, frames, parameters, **run)
        for a, b in zip(grads, expected, strict=True):
            assert (a - b).abs().max() < 1e-9 * b.abs().max()


def test_carrying_the_total_deformation_changes_nothing_else():
    """States, and gradients of a loss that does not read it, are the same bytes."""
    start, mass, vol0 = scene(TOUCHING)
    law, model, frames = make_law("von_mises"), MPM(14, DT), (0, 3, 12)
    for options in ({}, {"cache_bytes": 0}):
        found = []
        for total in (False, True):
            begin = tuple(value.clone().requires_grad_() for value in start)
            states = simulate(model, law, begin, mass, vol0, frames, total=total, **options)
            found.append((*states[:4], *torch.autograd.grad(random_loss()(states[:4]), begin)))
            assert len(states) == 4 + total
        assert all(torch.equal(a, b) for a, b in zip(*found, strict=True))


def corner(walls="outside"):
    """A model whose walls differ, and a cube in the corner where three of them meet."""
    boundary = {"y_min": "no_slip", "x_min": "slip", "z_min": "sticky"}
    thickness = {"wall_cells": 2} if walls == "released" else {}
    model = MPM(14, DT, boundary=boundary, walls=walls, **thickness)
    x, mass, vol0 = cube(COUNT, side=0.25, centre=3 * (0.22 if walls == "released" else TOUCHING,))
    return model, (x, *strained(x)), mass, vol0


@pytest.mark.parametrize("walls", ["outside", "released"])
@pytest.mark.parametrize("cache_bytes", [0, math.inf])
@pytest.mark.parametrize("name", ["von_mises", "drucker_prager", "fluid", "neural"])
def test_equals_torch_twin(name, cache_bytes, walls):
    """States and gradients of 15 steps, at walls of every kind and with plastic flow, to 1e-9."""
    model, start, mass, vol0 = corner(walls)
    law = make_law(name)
    parameters = trainable(law) if name == "neural" else []
    frames = (0, 4, 15)

    states = simulate(model, law, start, mass, vol0, frames)
    for a, b in zip(states, simulate_slowly(model, law, start, mass, vol0, frames), strict=True):
        assert (a - b).abs().max() < 1e-9 * b.abs().max()
    _, grads = gradients(model, law, start, mass, vol0, frames, parameters, cache_bytes=cache_bytes)
    _, expected = gradients(model, law, start, mass, vol0, frames, parameters, run=simulate_slowly)
    for a, b in zip(grads, expected, strict=True):
        assert (a - b).abs().max() < 1e-9 * b.abs().max()


def test_pressed_against_the_end_of_the_grid():
    """Particles that the released walls clamp where the stencil ends: states and gradients of the torch twin."""
    model = MPM(14, 2e-3, boundary="slip", walls="released")
    x, mass, vol0 = cube(COUNT, side=0.2, centre=(0.5, 0.18, 0.5))
    _, F, C = strained(x)
    v = torch.tensor([0.3, -8.0, 0.1], dtype=x.dtype).repeat(COUNT, 1)
    start, law, frames = (x, v, F, C), make_law("drucker_prager"), (4, 12)
    states = simulate(model, law, start, mass, vol0, frames)
    assert (states[0][-1, :, 1] == model.stencil_range[0]).sum() > 3
    _, grads = gradients(model, law, start, mass, vol0, frames)
    _, expected = gradients(model, law, start, mass, vol0, frames, run=simulate_slowly)
    for a, b in zip(grads, expected, strict=True):
        assert (a - b).abs().max() < 1e-9 * b.abs().max()


def test_several_bodies_equal_torch_twin():
    """Two bodies in contact, one law used twice and trained: its gradients add up."""
    model, start, mass, vol0 = corner()
    law, other = make_law("neural"), make_law("hencky")
    parameters = trainable(law)
    bodies = [MaterialRegion(law, 0, 25), MaterialRegion(other, 25, 40), MaterialRegion(law, 40, COUNT)]

    _, grads = gradients(model, bodies, start, mass, vol0, (10,), parameters)
    _, expected = gradients(model, bodies, start, mass, vol0, (10,), parameters, run=simulate_slowly)
    for a, b in zip(grads, expected, strict=True):
        assert (a - b).abs().max() < 1e-9 * b.abs().max()


def test_what_is_cached_does_not_change_the_gradient():
    """Everything, nothing but states, and an amount that is spent half-way give the same bytes."""
    start, mass, vol0 = scene(TOUCHING)
    law = make_law("neural")
    parameters = trainable(law)
    model = MPM(14, DT)
    step_bytes = 8 * (18 * COUNT + 8 * model.nodes**3)
    half_way = 12 * step_bytes + 7 * 2000 * COUNT
    everything, *others = (
        gradients(model, law, start, mass, vol0, (3, 12), parameters, cache_bytes=cache_bytes)[1]
        for cache_bytes in (math.inf, 0, half_way)
    )
    for grads in others:
        assert all(torch.equal(a, b) for a, b in zip(grads, everything, strict=True))


@pytest.mark.parametrize(
    "cache_bytes,segment,total",
    [(0, 5, False), (math.inf, 4, False), (math.inf, 2, False), (0, 5, True), (math.inf, 4, True)],
)
def test_checkpoints_do_not_change_the_gradient(cache_bytes, segment, total):
    """With little memory the steps are computed again, segment by segment: the same bytes, also the second time."""
    x, mass, vol0 = cube(2000, side=0.25, centre=(0.5, TOUCHING, 0.5))
    start, steps = (x, *strained(x)), 13
    law = make_law("neural")
    parameters = trainable(law)
    model, frames = MPM(9, DT), (0, 3, 7, steps)
    options = dict(cache_bytes=cache_bytes, total=total)
    _, expected = gradients(model, law, start, mass, vol0, frames, parameters, **options)
    state, step = 8 * (33 if total else 24) * len(x), 8 * (18 * len(x) + 8 * model.nodes**3)
    memory = state * (segment + 1 + math.ceil(steps / segment)) + step * (segment if cache_bytes else 1)
    options["memory"] = memory
    assert plan_memory(steps, len(x), model.nodes**3, 8, **options) == MemoryPlan(segment, cache_bytes > 0, 0)
    loss = random_loss()(simulate(model, law, start, mass, vol0, frames, **options))
    for _ in range(2):
        grads = torch.autograd.grad(loss, parameters, retain_graph=True)
        for a, b in zip(grads, expected[-len(grads) :], strict=True):
            assert torch.equal(a, b)


def test_too_little_memory():
    start, mass, vol0 = scene(TOUCHING)
    with refused("memory"):
        gradients(MPM(14, DT), make_law("neural"), start, mass, vol0, (13,), memory=1000)


def test_backward_twice():
    """A graph that is retained can be used again, also after other rollouts."""
    start, mass, vol0 = scene(TOUCHING)
    law = make_law("neural")
    parameters = trainable(law)
    model = MPM(14, DT)
    loss = random_loss()(simulate(model, law, start, mass, vol0, (3, 12), cache_bytes=math.inf))
    first = torch.autograd.grad(loss, parameters, retain_graph=True)
    random_loss()(simulate(model, law, start, mass, vol0, (3, 12))).backward()
    for a, b in zip(first, torch.autograd.grad(loss, parameters), strict=True):
        assert torch.equal(a, b)


def test_frames_add_up():
    """The gradient of a sum over frames is the sum of the gradients of rollouts that end at each frame."""
    start, mass, vol0 = scene()
    law = make_law("hencky")
    frames = (0, 2, 9)

    def grad_v(frames):
        v = start[1].clone().requires_grad_()
        states = simulate(IN_THE_AIR, law, (start[0], v, *start[2:]), mass, vol0, frames)
        return torch.autograd.grad((states[0] ** 2).sum() + states[1].sum(), v)[0]

    together = grad_v(frames)
    # Frames given one by one: v at frame 0 is the start itself.
    apart = sum(grad_v((n,)) for n in frames)
    torch.testing.assert_close(together, apart, rtol=1e-12, atol=1e-14)


@pytest.mark.parametrize("frames", [(3, 8), (5, 40)], ids=["in flight", "through contact"])
def test_gradient_through_a_skipped_flight(frames):
    """Closed form and simulation have the same gradient with respect to x0, one common v0 and the weights."""
    model = MPM(14, 2e-3)
    x0, mass, vol0 = cube(COUNT, side=0.25, centre=(0.5, 0.2, 0.5))
    law = make_law("neural")
    parameters = trainable(law)

    def grads(skip):
        x = x0.clone().requires_grad_()
        v = torch.tensor([0.3, -2.0, 0.1], dtype=torch.float64, requires_grad=True)
        state = State(x, v, mass, vol0)
        options = dict(skip_free_flight=skip, total=True)
        path = rollout(model, law, state, steps=frames[-1], frames=frames, **options)
        loss = random_loss()((path.x, path.v, path.F, path.C, path.F_total))
        return torch.autograd.grad(loss, (x, v, *parameters), materialize_grads=True)

    for a, b in zip(grads(True), grads(False), strict=True):
        assert (a - b).abs().max() < 1e-7 * max(1.0, float(b.abs().max()))


def test_float32_gradients_are_those_of_float64():
    start, mass, vol0 = scene(TOUCHING)
    grads = {}
    for dtype in (torch.float32, torch.float64):
        law = make_law("neural", dtype)
        inputs = [value.to(dtype) for value in (*start, mass, vol0)]
        _, grads[dtype] = gradients(ON_A_STICKY_FLOOR, law, inputs[:4], *inputs[4:], (20,), trainable(law))
    for a, b in zip(grads[torch.float32], grads[torch.float64], strict=True):
        assert (a - b).norm() < 1e-3 * b.norm()


def test_weights_take_the_precision_of_the_particles():
    """A law in float32 simulates particles in float64, and its gradients arrive in float32."""
    start, mass, vol0 = scene()
    law = make_law("neural", torch.float32)
    parameters = trainable(law)
    _, grads = gradients(IN_THE_AIR, law, start, mass, vol0, (5,), parameters)
    assert grads[0].dtype == torch.float64
    assert all(grad.dtype == torch.float32 and grad.abs().max() > 0 for grad in grads[4:])


def test_no_gradient_wanted_none_made():
    start, mass, vol0 = scene()
    with torch.no_grad():
        states = simulate(IN_THE_AIR, make_law("neural"), start, mass, vol0, (5,))
    assert not any(values.requires_grad for values in states)
    assert not any(v.requires_grad for v in simulate(IN_THE_AIR, make_law("hencky"), start, mass, vol0, (5,)))
