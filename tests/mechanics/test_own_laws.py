"""Laws that are not built in: the classes of the pages, from Python, a settings file and a law's file."""

import math
import re
from pathlib import Path

import pytest
import torch

import neuma_lib as nm
from neuma_lib.mechanics import catalogue
from neuma_lib.project.loading import load, read_yaml
from tests.support.errors import refused

pytestmark = [pytest.mark.core, pytest.mark.usefixtures("new_laws_are_forgotten")]

ROOT = Path(__file__).resolve().parents[2]
CUBIC = {"elasticity": {"name": "cubic_hencky", "E": 1e5, "nu": 0.3, "b": 20}}


@pytest.fixture
def own_laws(tmp_path) -> Path:
    """A file with the classes of the pages."""
    pages = "".join((ROOT / "docs" / page).read_text() for page in ("own_law.md", "extend.md"))
    blocks = re.findall(r"```python\n(.*?)```", pages, re.DOTALL)
    path = tmp_path / "my_law.py"
    path.write_text(
        "\n".join(block for block in blocks if "class " in block and "Elasticity, name=" in block)
    )
    return path


def settings(own_laws, **changes):
    raw = {**read_yaml(ROOT / "config/config.yaml"), "extensions": [str(own_laws)], **changes}
    return load(raw, ROOT)


def test_a_law_of_an_extension_is_used_in_settings_and_python(own_laws):
    chosen = settings(own_laws, scenes={"StiffDuck": {"like": "JellyDuck", "law": CUBIC}})
    spec = chosen.scene("StiffDuck").law.plain()
    assert catalogue.check_law(spec)["elasticity"]["b"] == 20
    law = nm.Law.from_spec(spec)
    F = torch.diag(torch.tensor([1.1, 1.0, 1.0], dtype=torch.float64))[None].requires_grad_()
    eps, mu, lam = math.log(1.1), 1e5 / 2.6, 1e5 * 0.3 / (1.3 * 0.4)
    expected = 2 * mu * eps * (1 + 20 * eps**2) + lam * eps
    assert law.elasticity(F)[0, 0, 0].item() == pytest.approx(expected, rel=1e-9)
    assert torch.autograd.gradcheck(law.elasticity, (F + 0.01,))
    with refused("CubicHencky.b"):
        nm.Law.from_spec({"elasticity": {**CUBIC["elasticity"], "b": -1}})


def test_a_law_of_an_extension_is_written_and_read(own_laws, tmp_path):
    settings(own_laws)
    nm.Law.from_spec(CUBIC).save(tmp_path / "law.safetensors", {})
    assert nm.Law.load(tmp_path / "law.safetensors").elasticity.values["b"] == 20
    with refused("elasticity"):
        nm.Law.from_spec({"elasticity": {"name": "quadratic", "k": 1e4}}).save(
            tmp_path / "other.safetensors", {}
        )


def test_a_name_is_taken_once():
    with refused(__name__):
        type("Mine", (nm.Elasticity,), {"__module__": __name__}, name="hencky")


def test_a_law_without_principal_stresses_is_simulated(own_laws):
    settings(own_laws)
    law = nm.Law.from_spec({"elasticity": {"name": "quadratic", "k": 1e4}})
    x = 0.3 + 0.2 * torch.rand(200, 3, generator=torch.Generator().manual_seed(0))
    vol0 = torch.full((200,), 0.2**3 / 200)
    F = torch.diag(torch.tensor([1.1, 1.0, 1.0])).expand(200, 3, 3)
    state = nm.State(x, torch.tensor([0.0, -1.0, 0.0]), 1000 * vol0, vol0, F)
    path = nm.simulate(nm.MPM(grid=16, dt=1e-3), law, state, [0, 10])
    path.x[-1].square().sum().backward()
    assert law.elasticity.k.grad.isfinite() and law.elasticity.k.grad != 0
