"""The examples of the first pages can be copied: their commands, settings and Python code run."""

import re
import shlex
import shutil
import sys
from pathlib import Path

import pytest
import trimesh

import neuma_lib as nm
from neuma_lib.cli import main

ROOT = Path(__file__).resolve().parents[1]
pytestmark = [pytest.mark.core, pytest.mark.usefixtures("new_laws_are_forgotten")]


@pytest.fixture
def project(tmp_path, monkeypatch):
    """A folder with the project's settings, as the current one, and a mesh outside of it."""
    folder = tmp_path / "project"
    shutil.copytree(ROOT / "config", folder / "config")
    shutil.copy(ROOT / "Snakefile", folder)
    monkeypatch.chdir(folder)
    return folder


def blocks(page: str, language: str) -> list[str]:
    return re.findall(rf"```{language}\n(.*?)```", (ROOT / "docs" / page).read_text(), re.DOTALL)


def commands(page: str, program: str) -> list[list[str]]:
    lines = re.findall(rf"^    {program} (.*)$", (ROOT / "docs" / page).read_text(), re.MULTILINE)
    return [shlex.split(line) for line in lines]


@pytest.mark.parametrize("page", ["own_scene.md", "own_mesh.md", "own_law.md"])
def test_the_site_has_the_page_and_its_commands_run(project, capsys, page):
    assert f": {page}\n" in (ROOT / "mkdocs.yml").read_text()
    trimesh.creation.annulus(0.03, 0.04, 0.08).export("cup.obj")
    (project / "meshes").mkdir()
    shutil.copy("cup.obj", "meshes/cup.obj")
    (settings,) = blocks(page, "yaml")
    (project / "my.yaml").write_text(settings)
    (project / "my_law.py").write_text("\n".join(b for b in blocks("own_law.md", "python") if "class " in b))
    assert main(["check", "my.yaml"]) == 0, capsys.readouterr().out
    run = commands(page, "neuma")
    assert run and all(main(words) == 0 for words in run), capsys.readouterr()
    for words in commands(page, "snakemake"):
        file, target = words[words.index("--configfile") + 1], words[-1]
        name = target.split("/")[1]
        assert f"\n  {name}:\n" in (project / file).read_text()


def test_the_python_code_of_the_pages_runs(project, monkeypatch):
    monkeypatch.syspath_prepend(str(project))
    law, use = blocks("own_law.md", "python")
    (project / "my_law.py").write_text(law)
    exec(use, names := {})
    assert isinstance(names["law"], nm.Law) and (project / "cubic.safetensors").is_file()
    del sys.modules["my_law"]
    turn, simulate = blocks("own_mesh.md", "python")
    trimesh.creation.cone(0.1, 0.3).apply_translation([0.5, 0.5, 0.4]).export("cup.stl")
    exec(turn, names := {})
    assert names["mesh"].extents.argmax() == 1  # upright
    names["mesh"].apply_translation([0.0, 0.0, 1.0]).export("part.stl")
    nm.Law.from_spec({"elasticity": {"name": "hencky", "E": 1e4, "nu": 0.3}}).save(
        "law.safetensors", {"dt": None}
    )
    exec(simulate.replace("range(0, 401, 10)", "range(0, 3)"), names := {})
    assert names["path"].x.shape[0] == 3
