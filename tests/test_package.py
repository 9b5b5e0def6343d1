"""The package: what an import loads, what a missing extra is answered with, what an archive holds."""

import pkgutil
import re
import subprocess
import sys
from pathlib import Path

import pytest
import yaml

import neuma_lib
from neuma_lib.extras import require
from tests.support.errors import refused

pytestmark = pytest.mark.core

ROOT = Path(__file__).resolve().parents[1]


def run(code: str) -> str:
    command = [sys.executable, "-c", code]
    return subprocess.run(command, check=True, capture_output=True, text=True, cwd=ROOT).stdout


def test_importing_the_library_loads_neither_torch_nor_numpy():
    code = "import sys, neuma_lib; print({'torch', 'warp', 'numpy', 'pydantic'} & set(sys.modules))"
    assert run(code).strip() == "set()"


def test_every_public_name_is_there():
    assert all(hasattr(neuma_lib, name) for name in neuma_lib.__all__)
    assert set(neuma_lib.__all__) <= set(dir(neuma_lib))
    with pytest.raises(AttributeError):
        neuma_lib.simulation_of_everything  # noqa: B018


def on_page(text: str) -> list[tuple[str, str]]:
    """Module or name of each ``:::`` entry of a page, and each of its members."""
    entries = re.findall(r"^::: (\S+)\n((?: +.*\n)*)", text, re.MULTILINE)
    return [
        (path, name)
        for path, options in entries
        for name in re.findall(r"\w+", "".join(re.findall(r"members: \[(.*)\]", options))) or [""]
    ]


@pytest.mark.parametrize("page", sorted((ROOT / "docs/api").glob("*.md")), ids=lambda page: page.stem)
def test_every_name_on_a_page_is_there(page):
    """mkdocs leaves members out that do not exist, without a warning."""
    missing = [
        (path, name) for path, name in on_page(page.read_text()) if not found(f"{path}.{name}".rstrip("."))
    ]
    assert not missing


def test_every_name_on_the_page_of_the_method_is_there():
    names = re.findall(r"`([a-z_]+(?:\.\w+)+)`", (ROOT / "docs/method.md").read_text())
    rooms = {module.name for module in pkgutil.iter_modules(neuma_lib.__path__) if module.ispkg}
    named = {f"neuma_lib.{name}" for name in names if name.split(".")[0] in rooms}
    assert len(named) > 20
    assert not {name for name in named if not found(name)}


def found(path: str) -> bool:
    try:
        pkgutil.resolve_name(path)
    except (ImportError, AttributeError):
        return False
    return True


BLOCKED = """
import importlib, importlib.abc, pkgutil, sys
EXTRAS = {"matplotlib", "imageio", "imageio_ffmpeg", "bpy", "mathutils", "cv2", "tqdm", "grimp", "snakemake", "psutil",
          "pycolmap", "pymeshlab", "viser", "pxr", "pysplashsurf", "pandas", "jinja2"}
class Blocked(importlib.abc.MetaPathFinder):
    def find_spec(self, name, path, target=None):
        if name.partition(".")[0] in EXTRAS:
            raise ModuleNotFoundError(name)
sys.meta_path.insert(0, Blocked())
import neuma_lib
for module in pkgutil.walk_packages(neuma_lib.__path__, "neuma_lib."):
    try:
        importlib.import_module(module.name)
    except ModuleNotFoundError:
        print(module.name)
"""
PLOTS = (
    "neuma_lib.paper.",
    "neuma_lib.evaluation.",
    "neuma_lib.capture.report.",
    "neuma_lib.data.blender.cycles",
    "neuma_lib.viewer.gate",
)
"""Modules that may need an extra at import: those that draw, run inside Blender or guard the viewer."""


def test_without_the_extras_everything_but_plots_and_blender_imports():
    missing = run(BLOCKED).split()
    assert [name for name in missing if not name.startswith(PLOTS)] == []


def test_a_missing_extra_is_named_with_its_command():
    with refused("no_such_package") as caught:
        require("no_such_package.part", "capture")
    assert 'pip install "neuma[capture]"' in str(caught.value)


def test_the_archives_hold_every_file_that_the_library_reads(tmp_path):
    pytest.importorskip("build")
    if not (ROOT / "neuma_lib").is_dir():
        pytest.skip("not a checkout")
    import tarfile
    import zipfile

    command = [sys.executable, "-m", "build", "--no-isolation", "--outdir", str(tmp_path), str(ROOT)]
    subprocess.run(command, check=True, capture_output=True)
    with zipfile.ZipFile(next(tmp_path.glob("*.whl"))) as wheel:
        in_wheel = set(wheel.namelist())
    with tarfile.open(next(tmp_path.glob("*.tar.gz"))) as sdist:
        in_sdist = {name.partition("/")[2] for name in sdist.getnames()}
    files = {
        str(file.relative_to(ROOT))
        for file in (ROOT / "neuma_lib").rglob("*")
        if file.is_file() and "__pycache__" not in file.parts
    }
    assert any(file.endswith(".cu") for file in files) and "neuma_lib/viewer/page.html" in files
    assert files <= in_wheel and files <= in_sdist
    assert not [name for name in in_wheel if name.startswith(("workflow", "tests", "benchmarks"))]


def test_the_citation_is_of_this_version():
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text())
    assert citation["version"] == neuma_lib.__version__ and citation["license"] == "MIT"
    assert (
        citation["cff-version"] == "1.2.0" and {"title", "authors", "message", "abstract"} <= citation.keys()
    )
    paper = citation["preferred-citation"]
    assert paper["title"].startswith("NeuMA") and len(paper["authors"]) == 6
