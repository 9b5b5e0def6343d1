"""Runs that are killed at random moments, and resumed until they finish."""

import os
import random
import signal
import subprocess
import sys
from functools import partial

import pytest

from tests.support.project import SCENE, TABLE, Project, copied, wait_for

KILLS = 30
LONGEST = 25.0  # seconds from the start of Snakemake to a kill
TARGETS = TABLE, f"{SCENE}/initial_state.json", f"{SCENE}/neuma/video.mp4"


def unlocked(project: Project) -> bool:
    """Whether `make unlock` worked, which refuses while a process of the killed run is alive."""
    make = ["make", "-o", "env", "unlock", f"VENV={sys.prefix}"]
    return subprocess.run(make, cwd=project.root, capture_output=True).returncode == 0


@pytest.mark.slow
def test_runs_killed_at_random_moments_end_with_the_same_files(finished, kernels, tmp_path):
    """As by a power cut (all processes), or by the kernel when memory is exhausted (Snakemake alone)."""
    moments = random.Random(0)
    expected = finished.artifacts()
    kills = 0
    while kills < KILLS:
        project = copied(tmp_path / f"after_{kills}_kills", kernels)
        while True:
            snakemake = project.start(*TARGETS)
            try:
                code = snakemake.wait(moments.uniform(2.0, LONGEST) if kills < KILLS else project.seconds)
            except subprocess.TimeoutExpired:
                moments.choice([os.kill, os.killpg])(snakemake.pid, signal.SIGKILL)
                snakemake.wait()
                kills += 1
                print(f"kill {kills}: {len(project.artifacts())} files")
                wait_for(partial(unlocked, project))
                continue
            assert code == 0, (project.root / "started.log").read_text()[-4000:]
            break
        assert project.artifacts() == expected
