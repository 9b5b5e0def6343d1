"""The catalogue of built-in laws agrees with the laws themselves, and refuses what they refuse."""

import pytest
import torch

from neuma_lib.mechanics import catalogue
from neuma_lib.mechanics.analytic import analytic_law, specification
from neuma_lib.mechanics.elasticity import ELASTICITIES
from neuma_lib.mechanics.plasticity import PLASTICITIES
from tests.support.errors import refused

pytestmark = pytest.mark.core

OTHERS = {
    "ogden": {"alpha": 8.0},
    "mooney_rivlin": {"q": 0.7},
    "fibre_reinforced": {"fibre_modulus": 1.5e5, "fibre_exponent": 1.0, "azimuth": 45.0, "elevation": 20.0},
}
HENCKY = {"name": "hencky", "E": 1e5, "nu": 0.3}


def test_every_law_has_the_constants_of_the_catalogue():
    for laws, known in ((ELASTICITIES, catalogue.ELASTICITY), (PLASTICITIES, catalogue.PLASTICITY)):
        assert {name: law.constants for name, law in laws.items()} == known


@pytest.mark.parametrize("nu", [-0.2, 0.0, 0.3, 0.48])
@pytest.mark.parametrize("name", catalogue.ELASTICITY)
def test_the_modulus_is_that_of_the_law(name, nu):
    elasticity = {"name": name, "E": 2e5, "nu": nu, **OTHERS.get(name, {})}
    measured = analytic_law({"elasticity": elasticity}).longitudinal_modulus()
    complete = catalogue.check_law({"elasticity": elasticity})["elasticity"]
    # One-sided differences of a step of 1e-5 measure it.
    assert catalogue.longitudinal_modulus(complete) == pytest.approx(max(measured, 0.0), rel=1e-3, abs=1.0)


def test_a_checked_law_is_the_specification_of_the_law():
    spec = {"elasticity": HENCKY, "plasticity": {"name": "viscous_flow", "viscosity": 50}}
    law = analytic_law(spec, dt=1e-3)
    assert catalogue.check_law(spec, dt=1e-3) == specification(law.elasticity, law.plasticity)


def test_tensors_are_kept_as_weights():
    E = torch.tensor(1e5, requires_grad=True)
    law = analytic_law({"elasticity": {**HENCKY, "E": E}})
    assert law.elasticity.weights() == (E,) and law.elasticity.values["nu"] == 0.3


@pytest.mark.parametrize(
    ("spec", "where"),
    [
        ({}, "law"),
        ({"elasticity": {**HENCKY, "name": "henky"}}, "elasticity.name"),
        ({"elasticity": {**HENCKY, "E": -1}}, "elasticity.E"),
        ({"elasticity": {**HENCKY, "E": float("nan")}}, "elasticity.E"),
        ({"elasticity": {"name": "hencky", "E": 1e5}}, "elasticity.nu"),
        ({"elasticity": HENCKY, "plasticity": {"name": "von_mises"}}, "plasticity.yield_stress"),
        ({"elasticity": HENCKY, "plasticity": {"name": "viscous_flow", "viscosity": 1}}, "dt"),
    ],
)
def test_wrong_laws_are_refused(spec, where):
    with refused(where):
        catalogue.check_law(spec)
