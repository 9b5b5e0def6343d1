"""Viscous parts of laws: against a torch twin with one set of particles, finite differences and closed forms."""

import math
from dataclasses import replace

import pytest
import torch

from benchmarks import torch_simulation
from neuma_lib.errors import NonFiniteError
from neuma_lib.mechanics.analytic import analytic_law
from neuma_lib.mechanics.catalogue import COURANT_LIMIT
from neuma_lib.sim.batch import rollout_batch
from neuma_lib.sim.clamps import Clamp
from neuma_lib.sim.colliders import Collider
from neuma_lib.sim.model import MPM, MaterialRegion
from neuma_lib.sim.rollout import rollout
from neuma_lib.sim.state import State
from tests.support.errors import refused
from tests.support.settle import settle
from tests.support.sim_scenes import DENSITY, DT, cube, loss_of, prism, strained

pytestmark = pytest.mark.core

ELASTIC = {"name": "neo_hookean", "E": 5e4, "nu": 0.3}
VISCOUS = {
    "kelvin_voigt": {"name": "kelvin_voigt", "viscosity": 20.0},
    "maxwell": {"name": "maxwell", "modulus": 2e4, "relaxation": 5e-3},
}
FLOOR = Collider.plane((0.0, 0.36, 0.0), (0.0, 1.0, 0.0), friction=0.3)
HELD = Clamp((0.0, 0.0, 0.0), (0.42, 1.0, 1.0), release=0.015)
STATE = ("x", "v", "F", "C", "F_branch")


def law_of(name, dt=DT, **tensors):
    """A law with a viscous part, of whose constants some are tensors."""
    return analytic_law({"elasticity": ELASTIC, "viscosity": {**VISCOUS[name], **tensors}}, dt)


def scene(**options):
    """A strained cube that moves, touches a floor, and is partly held at first."""
    model = MPM(14, DT, colliders=(FLOOR,), clamps=(HELD,), **options)
    x, mass, vol0 = cube(60)
    v, F, C = strained(x, size=0.02)
    generator = torch.Generator().manual_seed(5)
    turned = F + 0.02 * torch.randn(F.shape, generator=generator, dtype=F.dtype)
    return model, State(x, v, mass, vol0, F, C, F_branch=turned)


def constants_of(name):
    """Constants that are fitted, as leaves."""
    return {
        key: torch.tensor(value, dtype=torch.float64, requires_grad=True)
        for key, value in VISCOUS[name].items()
        if key != "name"
    }


@pytest.mark.parametrize("name", VISCOUS)
@pytest.mark.parametrize("memory", [None, 2e6])
def test_equals_the_torch_twin(name, memory):
    """States and gradients of 40 steps, with constants of the branch, also if states are recomputed."""
    model, start = scene()
    results = []
    for slow in (True, False):
        constants = constants_of(name)
        own = replace(start, **{key: getattr(start, key).clone().requires_grad_() for key in STATE})
        law = law_of(name, **constants)
        if slow:
            x, v, F, C = torch_simulation.rollout(model, law, own, (20, 40))
            path = replace(rollout(model, law, start, steps=40, frames=(20, 40)), x=x, v=v, F=F, C=C)
        else:
            path = rollout(model, law, own, steps=40, frames=(20, 40), memory=memory)
        leaves = [*(getattr(own, key) for key in STATE), *constants.values()]
        results.append((path, torch.autograd.grad(loss_of(path), leaves)))
    (twin, expected), (path, grads) = results
    torch.testing.assert_close(path.x, twin.x, rtol=0, atol=1e-12)
    torch.testing.assert_close(path.F, twin.F, rtol=0, atol=1e-10)
    for a, b in zip(grads, expected, strict=True):
        assert (a - b).abs().max() < 1e-8 * b.abs().max()


@pytest.mark.parametrize("name", VISCOUS)
def test_finite_differences_of_the_constants(name):
    """Central differences in logarithms of the constants, to their error of third order."""
    model, start = scene()
    constants = constants_of(name)
    path = rollout(model, law_of(name, **constants), start, steps=30, frames=(15, 30))
    grads = torch.autograd.grad(loss_of(path), list(constants.values()))
    for (key, value), grad in zip(constants.items(), grads, strict=True):
        step, values = 1e-3, []
        for sign in (1, -1):
            shifted = {**VISCOUS[name], key: VISCOUS[name][key] * math.exp(sign * step)}
            law = analytic_law({"elasticity": ELASTIC, "viscosity": shifted}, DT)
            values.append(float(loss_of(rollout(model, law, start, steps=30, frames=(15, 30)))))
        slope = float(grad * value.detach())
        assert abs((values[0] - values[1]) / (2 * step) - slope) < 1e-5 * abs(slope)


@pytest.mark.parametrize("name", VISCOUS)
def test_a_simulation_continues_exactly(name):
    """With F_branch, and only with it."""
    model, start = scene()
    model, law = replace(model, clamps=()), law_of(name)
    path = rollout(model, law, start, steps=20, frames=(10, 20))
    then = start.after(path, 0)
    again = rollout(model, law, then, steps=10, frames=(10,))
    torch.testing.assert_close(again.x[0], path.x[1], rtol=0, atol=1e-14)
    forgot = rollout(model, law, replace(then, F_branch=None), steps=10, frames=(10,))
    assert (forgot.x[0] - path.x[1]).abs().max() > 1e-6


def test_bodies_with_and_without_a_viscous_part():
    """Bodies apart move as they do alone, and particles without a branch have none."""
    model = MPM(20, DT, gravity=(0.0, -9.8, 0.0))
    starts = []
    for k, x0 in enumerate((0.3, 0.7)):
        x, mass, vol0 = cube(40, side=0.15, centre=(x0, 0.5, 0.5), seed=k)
        starts.append(State(x, *strained(x, size=0.02)[:1], mass, vol0, *strained(x, size=0.02)[1:]))
    plain = analytic_law({"elasticity": ELASTIC}, DT)
    laws, options = (plain, law_of("maxwell")), {"steps": 20, "frames": (10, 20)}
    both = State.joined(starts)
    regions = (MaterialRegion(laws[0], 0, 40), MaterialRegion(laws[1], 40, 80))
    path = rollout(model, regions, both, **options)
    assert torch.equal(path.F_branch[:, :40], torch.eye(3, dtype=both.x.dtype).expand(2, 40, 3, 3))
    for k, law in enumerate(laws):
        alone = rollout(model, law, starts[k], **options)
        torch.testing.assert_close(path.x[:, 40 * k : 40 * k + 40], alone.x, rtol=0, atol=1e-13)
    moved = [a.to("cpu") for a in (both.after(path), replace(both, F_branch=both.F))]
    assert all(state.F_branch is not None for state in moved)


def test_a_batch_equals_single_simulations():
    """Of laws with and without a viscous part, in their order."""
    model, start = scene()
    start = replace(start, F_branch=None)
    laws = [law_of("maxwell"), analytic_law({"elasticity": ELASTIC}, DT), law_of("kelvin_voigt")]
    for path, law in zip(rollout_batch(model, laws, start, steps=20, frames=(20,)), laws, strict=True):
        assert torch.equal(path.x, rollout(model, law, start, steps=20, frames=(20,)).x)


def vibration(viscosity, E=2e4, L=0.4, grid=24, periods=4.0):
    """Times [s], tip heights of a column that rings in its first mode without gravity, and the frequency of a bar."""
    top = round(0.8 * grid) / grid + 0.5 / grid
    clamp = Clamp((0.0, top, 0.0), (1.0, 1.0, 1.0))
    elastic = {"name": "neo_hookean", "E": E, "nu": 0.0}
    spec = {"elasticity": elastic, **({"viscosity": viscosity} if viscosity else {})}
    start = prism((0.1, L + 0.1, 0.1), 1 / (2 * grid), (0.45, top - L, 0.45))
    depth = (top - start.x[:, 1]).clamp(min=0.0, max=L)
    v = torch.zeros_like(start.x)
    v[:, 1] = -0.02 * torch.sin(math.pi * depth / (2 * L))
    omega = math.pi / (2 * L) * math.sqrt(E / DENSITY)
    dt = 0.02 / omega
    law = analytic_law(spec, dt)
    model = MPM(grid, dt, gravity=(0.0, 0.0, 0.0), clamps=(clamp,))
    model.check_courant(law, DENSITY)
    frames = range(int(periods * 2 * math.pi / omega / dt))
    path = rollout(model, law, replace(start, v=v), steps=frames[-1], frames=frames)
    tip = start.x[:, 1] < top - L + 0.02
    times = dt * torch.tensor(list(frames), dtype=torch.float64)
    return times, path.x[:, tip, 1].mean(1) - start.x[tip, 1].mean(), omega


def damping_and_frequency(times, height):
    """Damping ratio and angular frequency from the decay of the extremes and their times."""
    at = [
        k for k in range(1, len(height) - 1) if (height[k] - height[k - 1]) * (height[k + 1] - height[k]) <= 0
    ]
    a, b = at[0], at[-1]
    halves = len(at) - 1
    decrement = math.log(abs(float(height[a]) / float(height[b]))) / (math.pi * halves)
    return decrement, math.pi * halves / float(times[b] - times[a])


@pytest.mark.parametrize("name", VISCOUS)
def test_a_column_rings_with_the_damping_of_its_law(name):
    """Of small vibrations exp(s t) with the shear modulus G(s) = mu + G s T / (1 + s T).

    A column with nu = 0 and bulk modulus K has E(s) = 9 K G(s) / (3 K + G(s)), and s^2 = -w^2 E(s) / E with the
    frequency w without a viscous part, measured. The damping of the simulation itself, measured in the same way, is
    added. Its own change and that by the time step, w dt / 2 = 1 % of it, are neglected.
    """
    E = 2e4
    times, height, omega = vibration(None)
    numerical, plain = damping_and_frequency(times, height)
    assert numerical < 0.01
    mu, K = E / 2, E / 3
    if name == "kelvin_voigt":
        own = {"name": name, "viscosity": 0.12 * mu / omega}
        G, T = None, 0.0
    else:
        own = {"name": name, "modulus": 0.3 * mu, "relaxation": 0.8 / omega}
        G, T = own["modulus"], own["relaxation"]
    s = 1j * plain
    for _ in range(50):
        shear = mu + (own["viscosity"] * s if G is None else G * s * T / (1 + s * T))
        s = 1j * plain * (9 * K * shear / (3 * K + shear) / E) ** 0.5
    times, height, _ = vibration(own)
    damping, frequency = damping_and_frequency(times, height)
    expected = -s.real / s.imag
    assert 0.03 < expected < 0.06
    assert abs(damping - numerical - expected) < 0.02 * expected
    assert abs(frequency / s.imag - 1) < 5e-3


@pytest.mark.parametrize("name", VISCOUS)
def test_the_time_step_limit_includes_the_viscous_part(name):
    """A law that is stiff by its branch is stable at the limit of the Courant number, and not at twice that."""
    x, mass, vol0 = cube(400)
    v, F, C = strained(x, size=0.01)
    start = State(x, v, mass, vol0, F, C)
    for number, stable in ((COURANT_LIMIT, True), (2.2 * COURANT_LIMIT, False)):
        M, soft = DENSITY * (number / 16 / DT) ** 2, {"name": "neo_hookean", "E": 1e3, "nu": 0.0}
        if name == "kelvin_voigt":
            own = {"name": name, "viscosity": 0.75 * 1.5 * M * DT}
        else:
            own = {"name": name, "modulus": 0.75 * M * (1 + DT / 0.1), "relaxation": 0.05}
        law = analytic_law({"elasticity": soft, "viscosity": own}, DT)
        model = MPM(16, DT, gravity=(0.0, 0.0, 0.0))
        assert model.courant(law, DENSITY) == pytest.approx(number, rel=0.02)
        try:
            path = rollout(model, law, start, steps=300, frames=(300,))
            calm = bool((path.v[0].norm(dim=1).max() < 2 * v.norm(dim=1).max()).item())
        except NonFiniteError:
            calm = False
        assert calm == stable, number


def test_rest_is_that_of_the_elasticity():
    """A viscous part changes neither the state of rest nor the way to it."""
    top = 0.7
    start = prism((0.1, 0.3, 0.1), 0.025, (0.45, top - 0.2, 0.45))
    model = MPM(16, DT, clamps=(Clamp((0.0, top, 0.0), (1.0, 1.0, 1.0)),))
    options = {"tolerance": 1e-2, "quiet": 100}
    settled = [
        settle(model, law, start, **options)
        for law in (law_of("maxwell"), analytic_law({"elasticity": ELASTIC}, DT))
    ]
    assert torch.equal(settled[0].x, settled[1].x)
    assert settled[0].F_branch is None


def test_copies_with_viscous_parts_are_refused_together():
    model, start = scene()
    with refused("laws"):
        from neuma_lib.sim.rollout import fly_and_simulate

        fly_and_simulate(
            model, (MaterialRegion(law_of("maxwell"), 0, 60),), start, (5,), None, False, False, copies=2
        )
