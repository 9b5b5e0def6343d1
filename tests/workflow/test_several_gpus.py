"""Jobs of one Snakemake on several GPUs: each script gets one."""

import os
import subprocess
import sys
from collections import Counter
from pathlib import Path

import pytest

GPUS = Path(__file__).parents[2] / "workflow" / "gpus"
SCRIPT = "import os\nprint(os.environ.get('CUDA_VISIBLE_DEVICES'), flush=True)\ninput()\n"


@pytest.fixture
def start(tmp_path):
    """Starts a script and returns its process with what it sees; all are ended after the test."""
    running = []

    def begin(folder=".snakemake/scripts", **variables):
        script = tmp_path / folder / "job.py"
        script.parent.mkdir(parents=True, exist_ok=True)
        script.write_text(SCRIPT)
        known = {name: value for name, value in os.environ.items() if name != "CUDA_VISIBLE_DEVICES"}
        known |= {"PYTHONPATH": str(GPUS), "XDG_CACHE_HOME": str(tmp_path), "NEUMA_GPUS": "2", **variables}
        process = subprocess.Popen(
            [sys.executable, script], env=known, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
        )
        running.append(process)
        return process, process.stdout.readline().strip()

    yield begin
    for process in running:
        process.kill()
        process.communicate()


def test_scripts_are_spread_evenly_and_a_killed_one_leaves_its_place(start):
    jobs = [start() for _ in range(5)]
    assert [gpu for _, gpu in jobs] == ["0", "1", "0", "1", "0"]
    gone = jobs[1][0]
    gone.kill()
    gone.wait()
    again = [start()[1], start()[1]]
    assert again == ["1", "1"]
    assert Counter([gpu for job, gpu in jobs if job is not gone] + again) == {"0": 3, "1": 3}


def test_others_and_the_choice_of_a_user_are_left_alone(start):
    assert start(folder="elsewhere")[1] == "None"
    assert start(NEUMA_GPUS="")[1] == "None"
    assert start(CUDA_VISIBLE_DEVICES="7")[1] == "7"
