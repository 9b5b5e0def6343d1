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


FINISHED = tuple(
    f"/test_{name}.py" for name in ("exported_motions", "interrupted", "own_method", "provenance", "workflow")
)
"""Ends of the names of files whose tests share a finished run of the workflow, which takes minutes to make."""


def pytest_xdist_make_scheduler(config, log):
    """With several processes, one has all tests of a file, and one has the files that share the finished run.

    Groups of xdist (3.8) have no effect with pytest 9, which does not read the name that they change.
    """
    from xdist.scheduler import LoadFileScheduling

    class ByFile(LoadFileScheduling):
        def _split_scope(self, nodeid: str) -> str:
            file = super()._split_scope(nodeid)
            return "finished" if file.endswith(FINISHED) else file

    config.option.loadscopereorder = False
    return ByFile(config, log)


def pytest_collection_modifyitems(config, items):
    """Several processes begin with the tests of the workflow, the longest, so that none is left alone with them."""
    if hasattr(config, "workerinput"):
        items.sort(key=lambda item: item.path.parent.name != "workflow")


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
