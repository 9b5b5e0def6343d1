"""The viscous parts of laws at a material point, in specifications, and in files."""

import math

import pytest
import torch

from neuma_lib.export.materials import engine_material
from neuma_lib.fitting.families import MAX_COURANT, Family
from neuma_lib.mechanics.analytic import analytic_law, specification
from neuma_lib.mechanics.catalogue import check_law
from neuma_lib.mechanics.law import Law
from neuma_lib.mechanics.time_step import step_dependence
from neuma_lib.sim.model import MPM
from tests.support.errors import refused

pytestmark = pytest.mark.core

ELASTIC = {"name": "hencky", "E": 3e4, "nu": 0.25}
MU = 1.2e4
MAXWELL = {"name": "maxwell", "modulus": 5e3, "relaxation": 0.02}
KELVIN_VOIGT = {"name": "kelvin_voigt", "viscosity": 40.0}


def law_of(viscosity, dt=1e-4):
    return analytic_law({"elasticity": ELASTIC, "viscosity": viscosity}, dt)


def test_the_kernel_of_the_spring_equals_its_formula():
    """Values and derivatives, of which the formula's are those of autograd."""
    spring = law_of(MAXWELL).viscosity.branch.elasticity
    generator = torch.Generator().manual_seed(2)
    F = torch.eye(3, dtype=torch.float64) + 0.2 * torch.randn(50, 3, 3, generator=generator).double()
    grad = torch.randn(50, 3, 3, generator=generator).double()
    torch.testing.assert_close(spring.evaluate(F, ()), spring.response(F, ()), rtol=1e-12, atol=1e-9)
    slow = F.clone().requires_grad_()
    (expected,) = torch.autograd.grad(spring.response(slow, ()), slow, grad)
    torch.testing.assert_close(spring.vjp(F, (), grad)[0], expected, rtol=1e-9, atol=1e-6)
    volume = 1.3 * torch.eye(3, dtype=torch.float64)[None]
    assert spring.evaluate(volume, ()).abs().max() < 1e-9, "it has no bulk modulus"


@pytest.mark.parametrize("viscosity", [MAXWELL, KELVIN_VOIGT], ids=lambda own: own["name"])
def test_a_vibration_has_the_modulus_of_the_branch(viscosity):
    """G i w T / (1 + i w T), or i w viscosity, to a lag of 3/2 w dt = 0.45 %, in pure shear."""
    dt, omega, size = 1e-4, 30.0, 1e-3
    branch = law_of(viscosity, dt).viscosity.branch
    steps = round(2 * math.pi / omega / dt)
    F, last, inner = torch.eye(3, dtype=torch.float64)[None], 0.0, 0.0
    for n in range(1, 6 * steps + 1):
        strain = size * math.sin(omega * n * dt)
        change = torch.tensor([strain - last, last - strain, 0.0], dtype=torch.float64).exp()
        F, last = branch.plasticity(torch.diag(change) @ F), strain
        if n > 5 * steps:
            stress = float(branch.elasticity(F)[0, 0, 0]) / (2 * size)
            inner += 2 / steps * stress * complex(math.sin(omega * n * dt), math.cos(omega * n * dt))
    if viscosity is MAXWELL:
        turned = 1j * omega * MAXWELL["relaxation"]
        expected = MAXWELL["modulus"] * turned / (1 + turned)
    else:
        expected = 1j * omega * KELVIN_VOIGT["viscosity"]
    assert abs(inner - expected) < 5e-3 * abs(expected)


def test_specifications_keep_the_viscous_part():
    """With the time step, by name, and without one none."""
    spec = {"elasticity": ELASTIC, "viscosity": MAXWELL}
    law = analytic_law(spec, 1e-3)
    assert law.name == "hencky + identity + maxwell"
    assert specification(law.elasticity, law.plasticity, law.viscosity)["viscosity"] == {
        **MAXWELL,
        "dt": 1e-3,
    }
    assert check_law(spec, 1e-3)["viscosity"]["dt"] == 1e-3
    assert "viscosity" not in check_law({"elasticity": ELASTIC, "viscosity": None})
    assert step_dependence(law) == "follows"
    with refused("dt"):
        analytic_law(spec)
    with refused("viscosity.name"):
        law_of({"name": "zener"})
    with refused("viscosity.relaxation"):
        check_law({"elasticity": ELASTIC, "viscosity": {"name": "maxwell", "modulus": 1.0}}, 1e-3)
    with refused("viscosity"):
        engine_material(spec, 1000.0, 1e-3, "newton")


def test_a_file_keeps_the_viscous_part(tmp_path):
    """With the constants, and the time step of the simulation that reads it."""
    law_of(MAXWELL, 1e-3).save(tmp_path / "law.safetensors", {"dt": 1e-3})
    again = Law.load(tmp_path / "law.safetensors", dt=5e-4)
    assert again.viscosity.values == {"modulus": 5e3, "relaxation": 0.02, "dt": 5e-4}


def test_a_family_has_the_constants_of_the_viscous_part():
    """They are fitted as those of other parts, limited with E by the time step, and contain an elastic solid."""
    elastic = Family("elastic", {"elasticity": ELASTIC})
    family = Family("zener", {"elasticity": ELASTIC, "viscosity": MAXWELL})
    assert family.constants == ("E", "nu", "modulus", "relaxation")
    assert family.contains(elastic) and not elastic.contains(family)
    assert not family.flows
    values = family.bounded(family.unbounded(family.guess))
    assert values == pytest.approx(family.guess)
    assert family.law_spec(values)["viscosity"]["name"] == "maxwell"
    model = MPM(20, 1e-3)
    stiff = family.values(family.unbounded({**family.guess, "E": 1e6, "modulus": 1e6}), model, 1000.0)
    law = analytic_law(family.law_spec(stiff), model.dt)
    assert model.courant(law, 1000.0) == pytest.approx(MAX_COURANT)
    assert stiff["E"] == pytest.approx(stiff["modulus"]) and stiff["relaxation"] == pytest.approx(0.02)
    with refused("identify.families.x.viscosity"):
        Family("x", {"elasticity": ELASTIC, "viscosity": {**MAXWELL, "dt": 1e-3}})
    flow = {"name": "viscous_flow", "viscosity": 10.0}
    with refused("identify.families.x.viscosity"):
        Family("x", {"elasticity": ELASTIC, "plasticity": flow, "viscosity": KELVIN_VOIGT})
