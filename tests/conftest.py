"""Settings of every test run."""

from pathlib import Path

import pytest
import torch

from neuma_lib.mechanics import analytic, catalogue
from neuma_lib.mechanics.law import Elasticity, Plasticity
from neuma_lib.project import loading

# Two OpenMP threads on a busy machine cost far more than one.
torch.set_num_threads(1)


def pytest_ignore_collect(collection_path: Path, config):
    """With ``-m core``, leave out the files without such tests, whose imports may need an extra."""
    if "core" in config.option.markexpr and collection_path.suffix == ".py":
        return "mark.core" not in collection_path.read_text() or None
    return None


ROOT = Path(__file__).resolve().parents[1]


@pytest.fixture(scope="module")
def raw():
    return loading.read_yaml(ROOT / "config" / "config.yaml")


@pytest.fixture(scope="module")
def loaded(raw):
    return loading.load(raw, ROOT)


@pytest.fixture(scope="module")
def changed(raw):
    """A function of changes to the settings that returns the result."""
    return lambda **changes: loading.load(loading.merged(raw, changes), ROOT)


@pytest.fixture
def new_laws_are_forgotten():
    """Other tests see the built-in laws only, which are registered by the import of `analytic`."""
    assert analytic.ELASTICITIES is Elasticity.named
    known = (
        catalogue.ELASTICITY,
        catalogue.PLASTICITY,
        catalogue.DEFINED_IN,
        Elasticity.named,
        Plasticity.named,
    )
    before = [dict(each) for each in known]
    yield
    for each, old in zip(known, before, strict=True):
        each.clear()
        each.update(old)
