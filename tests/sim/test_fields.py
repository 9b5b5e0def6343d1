"""Materials that change along a body: factors on the stress, against bodies of two laws and a hanging bar."""

from dataclasses import replace

import pytest
import torch

from neuma_lib.mechanics.analytic import analytic_law, specification
from neuma_lib.sim.batch import rollout_batch
from neuma_lib.sim.clamps import Clamp
from neuma_lib.sim.model import MPM, MaterialRegion, with_fields
from neuma_lib.sim.rollout import rollout
from neuma_lib.sim.state import State
from tests.support.errors import refused
from tests.support.settle import settle
from tests.support.sim_scenes import DT, SPECS, cube, loss_of, prism, strained

pytestmark = pytest.mark.core

MODEL = MPM(14, DT)
FRAMES = (5, 20)
RUN = dict(steps=FRAMES[-1], frames=FRAMES)


def law_of(law="neo_hookean", **field):
    return analytic_law({**SPECS[law], **({"field": field} if field else {})}, DT)


def scene():
    """A strained cube that moves on the floor, of particles in the order of their x."""
    x, mass, vol0 = cube(80, side=0.25, centre=(0.5, 0.13, 0.5))
    x = x[x[:, 0].argsort()]
    v, F, C = strained(x, size=0.02)
    return State(x, v, mass, vol0, F, C)


@pytest.mark.parametrize("name", ["neo_hookean", "von_mises"])
def test_factors_equal_laws_of_other_moduli(name):
    """States and gradients of two ranges of particles with factors 1 and 3, and of two laws. Yield stresses follow."""
    start, half = scene(), 40
    stiff = {
        part: {key: 3 * value if key in ("E", "yield_stress") else value for key, value in own.items()}
        for part, own in SPECS[name].items()
    }
    two = [MaterialRegion(law_of(name), 0, half), MaterialRegion(analytic_law(stiff, DT), half, len(start.x))]
    factors = torch.ones_like(start.mass)
    factors[half:] = 3.0
    results = []
    for law, stiffness in ((two, None), (law_of(name), factors)):
        leaves = {key: getattr(start, key).clone().requires_grad_() for key in ("x", "v", "F", "C")}
        path = rollout(MODEL, law, replace(start, **leaves, stiffness=stiffness), **RUN)
        results.append((path, torch.autograd.grad(loss_of(path), list(leaves.values()))))
    (slow, expected), (path, grads) = results
    assert (slow.F - rollout(MODEL, law_of(name), start, **RUN).F).abs().max() > 1e-3
    for part in ("x", "v", "F", "C"):
        torch.testing.assert_close(getattr(path, part), getattr(slow, part), rtol=0, atol=1e-10)
    for one, other in zip(grads, expected, strict=True):
        assert (one - other).abs().max() < 1e-9 * other.abs().max()


def test_factors_along_the_body():
    x = torch.rand(500, 3, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    x[0], x[1] = 0.0, 1.0
    ramp = law_of(name="ramp", ratio=4.0).field
    torch.testing.assert_close(ramp.factors(x), 1 + 3 * x[:, 0])
    torch.testing.assert_close(ramp.factors(0.1 * x + 0.3), ramp.factors(x))
    up = law_of(name="ramp", ratio=0.5, elevation=90.0).field
    torch.testing.assert_close(up.factors(x), 1 - 0.5 * x[:, 1])
    halves = law_of(name="halves", ratio=4.0, boundary=0.3, azimuth=90.0).field
    factors = halves.factors(x)
    assert (factors[x[:, 2] < 0.15] - 1).abs().max() < 2e-3
    assert (factors[x[:, 2] > 0.45] - 4).abs().max() < 2e-3
    assert ((factors > 2.5) == (x[:, 2] > 0.3)).all()


def test_a_law_has_its_field():
    """Also in a batch, on a viscous branch, and where a simulation continues from a deformed state."""
    spec = {**SPECS["neo_hookean"], "field": {"name": "ramp", "ratio": 3.0}}
    law = analytic_law(spec, DT)
    x, mass, vol0 = cube(80, side=0.25, centre=(0.5, 0.14, 0.5))
    start = State.rigid(x, mass, vol0, (0.3, -2.0, 0.1), (1.0, 2.0, 3.0))
    factors = law.field.factors(x)
    path = rollout(MODEL, law, start, steps=60, frames=(30, 60))
    given = rollout(MODEL, law_of(), replace(start, stiffness=factors), steps=60, frames=(30, 60))
    assert torch.equal(path.x, given.x)
    uniform, batched = rollout_batch(MODEL, [law_of(), law], start, steps=60, frames=(30, 60))
    torch.testing.assert_close(batched.x, path.x, rtol=0, atol=1e-12)
    assert (uniform.x - path.x).abs().max() > 1e-3
    placed = with_fields(start, [MaterialRegion(law, 0, len(x))])
    first = rollout(MODEL, law, placed, steps=30, frames=(30,))
    second = rollout(MODEL, law, placed.after(first), steps=30, frames=(30,))
    torch.testing.assert_close(second.x, path.x[1:], rtol=0, atol=1e-12)
    viscous = {"viscosity": {"name": "maxwell", "modulus": 2e4, "relaxation": 5e-3}}
    tripled = {
        "elasticity": {**SPECS["neo_hookean"]["elasticity"], "E": 1.5e5},
        "viscosity": {**viscous["viscosity"], "modulus": 6e4},
    }
    law = analytic_law({**SPECS["neo_hookean"], **viscous}, DT)
    own = rollout(MODEL, law, replace(start, stiffness=torch.full_like(mass, 3.0)), steps=60, frames=(60,))
    other = rollout(MODEL, analytic_law(tripled, DT), start, steps=60, frames=(60,))
    torch.testing.assert_close(own.x, other.x, rtol=0, atol=1e-10)


def test_states_with_and_without_factors_join():
    start = scene()
    factors = torch.full_like(start.mass, 2.0)
    joined = State.joined([start, replace(start, stiffness=factors)])
    assert torch.equal(joined.stiffness, torch.cat([torch.ones_like(factors), factors]))
    assert State.joined([start, start]).stiffness is None
    assert torch.equal(joined.to("cpu").stiffness, joined.stiffness)
    with refused("state.stiffness"):
        replace(start, stiffness=-factors)


def test_a_field_makes_waves_faster_and_survives_a_file(tmp_path):
    spec = {**SPECS["hencky"], "field": {"name": "halves", "ratio": 4.0, "boundary": 0.4}}
    law = analytic_law(spec, DT)
    assert law.wave_speed(1000.0) == pytest.approx(2 * analytic_law(SPECS["hencky"], DT).wave_speed(1000.0))
    law.save(tmp_path / "law.safetensors", {})
    again = type(law).load(tmp_path / "law.safetensors")
    parts = [specification(own.elasticity, own.plasticity, own.viscosity, own.field) for own in (law, again)]
    assert parts[0] == parts[1] and parts[0]["field"]["boundary"] == 0.4
    with refused("Halves.boundary"):
        analytic_law({**SPECS["hencky"], "field": {"name": "halves", "ratio": 4.0, "boundary": 1.4}}, DT)


def test_a_hanging_bar_of_two_halves():
    """The stress of a bar that hangs from its upper end follows from the weight below alone. A lower half that is three
    times as stiff therefore extends a third as far. Both have the error of the grid."""
    model = MPM(20, 5e-4, clamps=(Clamp((0.0, 0.8, 0.0), (1.0, 1.0, 1.0)),))
    start = prism((0.1, 0.5, 0.1), 0.025, (0.45, 0.4, 0.45))
    extension = {}
    for ratio in (1.0, 3.0):
        field = {"name": "halves", "ratio": ratio, "boundary": 0.4, "azimuth": 0.0, "elevation": -90.0}
        law = analytic_law({"elasticity": {"name": "hencky", "E": 1e5, "nu": 0.0}, "field": field}, 5e-4)
        rest = settle(model, law, start, tolerance=1e-3)
        y = start.x[:, 1]
        lower, middle = y < 0.43, (y - 0.55).abs() < 0.015
        moved = (rest.x - start.x)[:, 1]
        extension[ratio] = float(moved[middle].mean() - moved[lower].mean())
    assert extension[1.0] > 5e-4
    assert extension[3.0] == pytest.approx(extension[1.0] / 3, rel=0.1)
