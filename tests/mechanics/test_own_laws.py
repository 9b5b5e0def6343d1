"""Laws in a file of the user, which settings name like the built-in ones."""

import pytest
import torch

from neuma_lib.extensions import load_laws, load_module
from neuma_lib.mechanics import catalogue
from neuma_lib.mechanics.analytic import analytic_law, specification
from neuma_lib.mechanics.elasticity import ELASTICITIES
from neuma_lib.project import cases, checks, loading
from neuma_lib.sim.model import MPMModel
from neuma_lib.sim.rollout import rollout
from neuma_lib.sim.state import State
from tests.support.errors import refused

FILE = '''
from neuma_lib.mechanics.catalogue import POISSON, YOUNG, Constant
from neuma_lib.mechanics.elasticity import AnalyticElasticity


class CubicHencky(AnalyticElasticity, name="cubic_hencky"):
    """tau_i = 2 mu eps_i (1 + b eps_i^2) + lam tr(eps)."""

    constants = {"E": YOUNG, "nu": POISSON, "b": Constant("1", 0.0)}

    def principal(self, sigma, mu, lam, b):
        eps = sigma.log()
        return 2 * mu * eps * (1 + b * eps**2) + lam * eps.sum(1, keepdim=True)
'''
CUBIC = {"name": "cubic_hencky", "E": 1e5, "nu": 0.3, "b": 20.0}
SOFT = {"name": "hencky", "E": 1e5, "nu": 0.3}


@pytest.fixture
def file(tmp_path):
    path = tmp_path / "my_law.py"
    path.write_text(FILE)
    yield path
    catalogue.ELASTICITY.pop("cubic_hencky", None)
    catalogue.DEFINED_IN.clear()
    ELASTICITIES.pop("cubic_hencky", None)


def test_a_law_is_built_from_its_specification(file):
    load_laws([str(file)])
    law = analytic_law({"elasticity": CUBIC})
    F = torch.diag(torch.tensor([1.2, 0.9, 1.0], dtype=torch.float64))[None]
    eps = F.diagonal(dim1=1, dim2=2).log()
    mu, lam = 1e5 / 2.6, 0.3e5 / (1.3 * 0.4)
    expected = 2 * mu * eps * (1 + 20 * eps**2) + lam * eps.sum()
    torch.testing.assert_close(law.elasticity(F).diagonal(dim1=1, dim2=2), expected)
    assert specification(law.elasticity, law.plasticity)["elasticity"] == CUBIC
    F = (torch.eye(3) + 0.1 * torch.randn(4, 3, 3)).double().requires_grad_()
    assert torch.autograd.gradcheck(law.elasticity, F)


def test_it_is_simulated(file):
    load_laws([str(file)])
    x = 0.1 * torch.rand(100, 3, generator=torch.Generator().manual_seed(0)) + torch.tensor([0.4, 0.15, 0.4])
    vol0 = torch.full((100,), 1e-5)
    start = State(x, torch.tensor([0.0, -3.0, 0.0]), 1000 * vol0, vol0)
    ends = [
        rollout(
            MPMModel(grid=16, dt=1e-3), analytic_law({"elasticity": part}), start, steps=60, frames=(60,)
        ).x[0]
        for part in (CUBIC, {**CUBIC, "b": 1e-9}, SOFT)
    ]
    torch.testing.assert_close(ends[1], ends[2], atol=1e-5, rtol=0)
    assert (ends[0] - ends[2]).abs().max() > 1e-4


def test_settings_name_it(file, raw):
    def loaded(law):
        return loading.load({**raw, "extensions": [str(file)], "scenes": {"BouncyBall": {"law": law}}})

    settings = loaded({"elasticity": CUBIC})
    assert cases.case(settings, "BouncyBall", "true_law").scene_law["elasticity"] == CUBIC
    assert checks.law_problems(settings) == []
    problem, *_ = checks.law_problems(loaded({"elasticity": {**CUBIC, "b": -1}}))
    assert "scenes.BouncyBall.law.elasticity.b" in problem


def test_a_name_that_is_taken_is_refused(file):
    file.write_text(FILE.replace("cubic_hencky", "hencky"))
    with refused(file):
        load_module(str(file))
    assert ELASTICITIES["hencky"].__module__ == "neuma_lib.mechanics.elasticity"


@pytest.mark.parametrize("files", ["my_law.py", [3], {"my_law.py": 1}])
def test_extensions_are_a_list_of_files(files):
    with refused("extensions"):
        loading.load({"extensions": files})
