"""What Python does before a script: several GPUs for the jobs of one Snakemake, one thread for libraries, and no
collection of garbage."""

import os
import subprocess
import sys
from collections import Counter
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
INTERPRETER = ROOT / "workflow" / "interpreter"
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
        known |= {
            "PYTHONPATH": str(INTERPRETER),
            "XDG_CACHE_HOME": str(tmp_path),
            "NEUMA_GPUS": "2",
            **variables,
        }
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


@pytest.mark.skipif(sys.platform != "linux", reason="counts the threads in /proc")
def test_libraries_use_one_thread_whatever_the_threads_of_the_job(tmp_path):
    """Snakemake sets these variables to the threads of the job."""
    script = tmp_path / ".snakemake" / "scripts" / "job.py"
    script.parent.mkdir(parents=True)
    script.write_text(
        "import os\nimport numpy as np\nnp.ones((500, 500)) @ np.ones((500, 500))\n"
        "print(len(os.listdir('/proc/self/task')))\n"
    )
    limits = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "2")
    environment = os.environ | limits | {"PYTHONPATH": str(INTERPRETER)}
    done = subprocess.run([sys.executable, script], env=environment, stdout=subprocess.PIPE)
    assert done.stdout == b"1\n"


def test_garbage_is_collected_from_the_stage_on_without_the_objects_of_imports(tmp_path):
    script = tmp_path / ".snakemake" / "scripts" / "job.py"
    script.parent.mkdir(parents=True)
    script.write_text("""
import gc
from types import SimpleNamespace
assert not gc.isenabled()
from workflow.stage import run_script
about = {name: {} for name in ("config", "input", "output", "params")}
snakemake = SimpleNamespace(rule="job", wildcards=[], log=["job.log"], **about)
run_script(lambda *parts: print(gc.isenabled(), gc.get_freeze_count() > 10_000), snakemake)
""")
    path = os.pathsep.join([str(INTERPRETER), str(ROOT)])
    done = subprocess.run(
        [sys.executable, script], cwd=tmp_path, env=os.environ | {"PYTHONPATH": path}, stdout=subprocess.PIPE
    )
    assert done.stdout == b"True True\n"


def test_optimisers_work_without_torchs_compiler_which_is_imported_once_it_is_needed():
    """Its import includes that of sympy."""
    script = """
import sys
from workflow.stage import NoCompiler
sys.modules["torch._dynamo"] = NoCompiler("torch._dynamo")
import torch
for kind in (torch.optim.Adam, torch.optim.LBFGS):
    x = torch.ones(2, requires_grad=True)
    optimizer = kind([x], lr=0.1)
    loss = lambda: (optimizer.zero_grad(), (x**2).sum())[1]
    def closure():
        value = loss()
        value.backward()
        return value
    before = float(loss())
    optimizer.step(closure)
    optimizer.load_state_dict(optimizer.state_dict())
    assert loss() < before
torch.optim.lr_scheduler.OneCycleLR(optimizer, 1.0, 10, cycle_momentum=False).step()
print("sympy" in sys.modules)
torch._dynamo.reset()
print("sympy" in sys.modules, torch.compile(lambda x: 2 * x, backend="eager")(torch.ones(1)).item())
"""
    done = subprocess.run([sys.executable, "-c", script], cwd=ROOT, capture_output=True, text=True)
    assert done.stdout.split() == ["False", "True", "2.0"], done.stderr
