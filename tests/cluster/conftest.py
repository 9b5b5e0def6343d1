"""A SLURM of our own for the tests of this folder, and what it needs. On request: ``pytest tests/cluster``."""

import importlib.util
import sys

import pytest

from tests.support.project import TABLE, Project, copied
from tests.support.slurm import cluster, missing

PLUGIN = "snakemake_executor_plugin_slurm"
# The plugin's first query of its jobs comes after 40 seconds by default.
EXECUTOR = ("--workflow-profile", "profiles/slurm", "--slurm-init-seconds-before-status-checks", "3")
SECONDS = 3 * 3600.0


@pytest.fixture(scope="session")
def slurm():
    """A running SLURM, in the environment of all that is started."""
    if problem := missing():
        pytest.fail(f"SLURM: {problem}", pytrace=False)
    if importlib.util.find_spec(PLUGIN) is None:
        pytest.fail(
            f"{sys.executable} has no {PLUGIN}: see the head of profiles/slurm/config.yaml", pytrace=False
        )
    with cluster(gpus=1, min_job_age=86400) as running, pytest.MonkeyPatch.context() as patch:
        for name, value in running.environment.items():
            patch.setenv(name, value)
        yield running


@pytest.fixture(scope="session")
def kernels(tmp_path_factory):
    """A kernel cache that all copies share."""
    return tmp_path_factory.mktemp("kernels")


@pytest.fixture(scope="session")
def finished(slurm, kernels, tmp_path_factory):
    """A copy in which SLURM has made Table 1 from nothing. Tests leave it as they found it."""
    copy = copied(tmp_path_factory.mktemp("project"), kernels)
    project = Project(copy.root, EXECUTOR, SECONDS)
    project.output = project.run(TABLE)
    return project


@pytest.fixture
def clone(finished, tmp_path):
    """A finished copy to spoil."""
    return finished.clone(tmp_path / "clone")
