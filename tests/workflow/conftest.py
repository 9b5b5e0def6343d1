"""What the tests of the workflow share: a finished run of Table 1, and one of everything else."""

from pathlib import Path

import pytest
import warp as wp

from neuma_lib.device import start_warp
from tests.support.full_run import run_in_full
from tests.support.project import SCENE, TABLE, copied


@pytest.fixture(scope="session")
def kernels():
    """The kernel cache of all tests, which copies of the project share."""
    start_warp()
    return Path(wp.config.kernel_cache_dir).parent  # Warp adds its version


@pytest.fixture(scope="session")
def finished(tmp_path_factory, kernels):
    """A copy in which Table 1 has been made from nothing. Tests leave it as they found it."""
    project = copied(tmp_path_factory.mktemp("project"), kernels)
    project.output = project.run(TABLE, f"{SCENE}/initial_state.json", f"{SCENE}/neuma/video.mp4")
    return project


@pytest.fixture(scope="session")
def full(finished, tmp_path_factory):
    """A finished copy with everything of `full_run`. Tests leave it as they found it."""
    return run_in_full(finished.clone(tmp_path_factory.mktemp("full") / "project"))


@pytest.fixture
def clone(finished, tmp_path):
    """A finished copy to spoil."""
    return finished.clone(tmp_path / "clone")
