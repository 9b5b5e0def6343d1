"""The locked environments: made from the pins, usable elsewhere; and what is told when something is missing."""

import re
import subprocess
import tomllib
from pathlib import Path

import pytest
import yaml

from neuma_lib.data.blender.libraries import explain_import_error

ROOT = Path(__file__).resolve().parents[2]
ENVS = ROOT / "envs"
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]


def requirements(name):
    lines = (ENVS / name).read_text().splitlines()
    return [line for line in lines if line and not line.startswith("#")]


@pytest.mark.parametrize("name", [f"requirements{kind}.txt" for kind in ("", "-dev", "-capture", "-viewer")])
def test_every_line_is_an_exact_version_that_any_index_can_serve(name):
    for line in requirements(name):
        assert re.fullmatch(r"[a-z0-9._-]+==[0-9][0-9a-z.]*", line), line


@pytest.mark.parametrize(
    ("pins", "name"),
    [
        (PROJECT["dependencies"], "requirements.txt"),
        (PROJECT["dependencies"] + PROJECT["optional-dependencies"]["dev"], "requirements-dev.txt"),
        (PROJECT["dependencies"] + PROJECT["optional-dependencies"]["capture"], "requirements-capture.txt"),
        (PROJECT["dependencies"] + PROJECT["optional-dependencies"]["viewer"], "requirements-viewer.txt"),
    ],
)
def test_locked_files_follow_the_pins(pins, name):
    assert set(pins) <= set(requirements(name)), "run: make lock"


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


def test_a_missing_system_library_is_named_with_its_package():
    text = "ImportError: libXi.so.6: cannot open shared object file: No such file or directory"
    assert "apt-get install libxi6" in explain_import_error(text).remedy
