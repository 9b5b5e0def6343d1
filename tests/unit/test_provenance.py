"""The code digest changes when, and only when, something that a script reaches changes."""

import textwrap
from pathlib import Path

import pytest

from workflow.provenance import code_digest, fingerprint, reached_modules

ROOT = Path(__file__).resolve().parents[2]
SCRIPTS = ROOT / "workflow" / "scripts"
READERS = "import json\ndef read_a(): return helper()\ndef helper(): return 1\ndef read_b(): return 2\n"


@pytest.fixture
def project(tmp_path):
    """A small package in the place of the library, and a script."""

    def write(name, text):
        path = tmp_path / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(textwrap.dedent(text))
        return path

    write("neuma_lib/__init__.py", "")
    write(
        "neuma_lib/render/__init__.py",
        "from neuma_lib.splatting.fast import draw\nfrom neuma_lib.splatting.cam import Cam\n",
    )
    write("neuma_lib/render/fast.py", "from . import kernels\ndef draw(): return kernels.k()\n")
    write("neuma_lib/render/kernels.py", "def k(): return 1\n")
    write("neuma_lib/render/cam.py", "class Cam: pass\n")
    write("neuma_lib/other.py", "x = 1\n")
    write(
        "neuma_lib/io.py",
        READERS,
    )
    write("script.py", "from neuma_lib.splatting import draw\nfrom neuma_lib.io.files import read_a\n")
    write.root = tmp_path
    return write


def digest(project, script="script.py"):
    return code_digest(project.root / script, project.root)


def test_reaches_through_packages_and_relative_imports(project):
    modules = reached_modules(project.root / "script.py", project.root)
    assert {"neuma_lib.splatting.fast", "neuma_lib.splatting.kernels", "neuma_lib.io.files"} <= set(modules)
    assert "neuma_lib.splatting.cam" not in modules and "neuma_lib.other" not in modules


@pytest.mark.parametrize(
    ("file", "text", "changes"),
    [
        ("neuma_lib/render/kernels.py", "def k(): return 2\n", True),
        ("neuma_lib/render/kernels.py", '"""Documented."""\n\ndef k():\n    """One."""\n    return 1  # one\n', False),
        ("neuma_lib/render/cam.py", "class Cam: x = 1\n", False),
        ("neuma_lib/other.py", "x = 2\n", False),
        ("neuma_lib/io.py", READERS.replace("return 2", "return 3"), False),
        ("neuma_lib/io.py", READERS.replace("return 1", "return 9"), True),
        ("script.py", "from neuma_lib.splatting import draw\nfrom neuma_lib.io.files import read_a\nprint(1)\n", True),
    ],
)  # fmt: skip
def test_changes_that_count(project, file, text, changes):
    before = digest(project)
    path = project(file, text)
    import os

    os.utime(path, ns=(1, 1))
    assert (digest(project) != before) == changes


def test_imports_inside_functions_count(project):
    project("script.py", "def main():\n    import neuma_lib.other\n")
    before = digest(project)
    project("neuma_lib/other.py", "x = 5\n")
    assert digest(project) != before


def test_whole_package_import_reaches_all_of_it(project):
    project("script.py", "import neuma_lib.splatting as r\nr.draw()\n")
    assert "neuma_lib.splatting.cam" in reached_modules(project.root / "script.py", project.root)


class TestThisProject:
    def reached(self, script):
        return set(reached_modules(SCRIPTS / f"{script}.py", ROOT))

    @pytest.mark.parametrize("script", ["gaussians", "velocity", "material", "video"])
    def test_what_renders_depends_on_the_rasterizer(self, script):
        assert "neuma_lib.splatting.rasterizer" in self.reached(script)

    @pytest.mark.parametrize(
        "script", ["ground_truth", "prior", "particles", "render_static", "render_dynamic", "chamfer_table"]
    )
    def test_what_does_not_render_is_free_of_it(self, script):
        assert "neuma_lib.splatting.rasterizer" not in self.reached(script)

    @pytest.mark.parametrize("script", ["gaussians", "mesh", "binding", "velocity", "material"])
    def test_no_stage_can_reach_the_truth(self, script):
        reached = self.reached(script)
        assert "neuma_lib.data.ground_truth" not in reached and "neuma_lib.geometry.shapes" not in reached


def test_fingerprint_names_what_changed(tmp_path):
    (tmp_path / "input").write_text("a")
    first = fingerprint({"lr": 0.1, "big": list(range(100))}, {"video": tmp_path / "input"}, "c0de")
    (tmp_path / "input").write_text("b")
    second = fingerprint({"lr": 0.2, "big": list(range(100))}, {"video": tmp_path / "input"}, "c0de")
    assert {k for k in first if first[k] != second[k]} == {"setting lr", "input video"}
    assert all(len(v) <= 40 for v in first.values())
