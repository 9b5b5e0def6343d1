"""The locked environments follow pyproject.toml and the pins; messages name what is missing on the machine."""

import re
import subprocess
import tomllib
from pathlib import Path

import pytest
import yaml

from workflow.defaults import has_gpu, torch_has_gpu

ROOT = Path(__file__).resolve().parents[2]
ENVS = ROOT / "envs"
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]


def requirements(name):
    lines = (line.partition("#")[0].strip() for line in (ENVS / name).read_text().splitlines())
    return [line for line in lines if line]


PINS = requirements("pins.txt")


@pytest.mark.parametrize("name", [file.name for file in sorted(ENVS.glob("requirements*.txt"))])
def test_every_line_is_an_exact_version_that_any_index_can_serve(name):
    for line in requirements(name):
        assert re.fullmatch(r"[a-z0-9._-]+==[0-9][0-9a-z.]*", line), line


def names(requirements):
    """Names of packages, without versions, extras and markers."""
    return {re.match(r"[A-Za-z0-9._-]+", line)[0].lower() for line in requirements}


def test_every_package_of_the_project_has_one_exact_pin():
    wanted = names(PROJECT["dependencies"]).union(*map(names, PROJECT["optional-dependencies"].values()))
    assert names(PINS) == wanted
    assert len(PINS) == len(wanted)


@pytest.mark.parametrize("extra", ["dev", "capture", "viewer", "docs", "engines"])
def test_locked_files_follow_the_pins(extra):
    locked = requirements(f"requirements-{extra}.txt")
    extras = PROJECT["optional-dependencies"]
    wanted = names(PROJECT["dependencies"]).union(*(names(extras[e]) for e in ("workflow", "blender", extra)))
    pins = {line for line in PINS if names([line]) <= wanted}
    assert pins <= set(locked), "run: make lock"
    assert set(requirements("requirements.txt")) <= set(locked), "run: make lock"


@pytest.mark.parametrize("kind", ["", "-capture"])
def test_conda_environment_holds_the_same(kind):
    environment = yaml.safe_load((ENVS / f"conda{kind}.yaml").read_text())
    assert environment["dependencies"][0] == "python=3.11"
    assert environment["dependencies"][-1]["pip"] == requirements(f"requirements{kind}.txt")


def test_a_missing_python_is_named(tmp_path):
    command = ["make", "env", f"VENV={tmp_path / 'venv'}", "PYTHON=python3.99"]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True)
    assert done.returncode != 0
    assert "Python 3.11 is needed" in done.stderr and "apt-get install python3.11" in done.stderr
    assert not (tmp_path / "venv").exists()


@pytest.mark.parametrize(
    "program, torch, devices, gpu, torch_gpu",
    [
        ("/usr/bin/nvidia-smi", "2.13.0", None, True, True),
        ("/usr/bin/nvidia-smi", "2.13.0+cu128", "0,1", True, True),
        (None, "2.13.0", None, False, False),
        ("/usr/bin/nvidia-smi", "2.13.0+cpu", None, True, False),
        ("/usr/bin/nvidia-smi", "2.13.0", "", False, False),
        ("/usr/bin/nvidia-smi", "2.13.0", "-1", False, False),
    ],
)
def test_jobs_use_a_gpu_only_if_torch_can_and_blender_with_the_driver(
    program, torch, devices, gpu, torch_gpu, monkeypatch
):
    """A driver alone made every job one for the GPU, of which one runs at a time."""
    monkeypatch.setattr("workflow.defaults.shutil.which", lambda name: program)
    monkeypatch.setattr("workflow.defaults.version", lambda name: torch)
    monkeypatch.delenv("CUDA_VISIBLE_DEVICES", raising=False)
    if devices is not None:
        monkeypatch.setenv("CUDA_VISIBLE_DEVICES", devices)
    assert (has_gpu(), torch_has_gpu()) == (gpu, torch_gpu)
