"""The command `neuma`: new settings that are valid, and checks that name every problem."""

import contextlib
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
import trimesh
import yaml

from neuma_lib.cli import main
from neuma_lib.io.files import write_json
from neuma_lib.project import checks
from neuma_lib.project.project import Project
from neuma_lib.project.scaffold import next_scene

ROOT = Path(__file__).resolve().parents[1]
core = pytest.mark.core


@pytest.fixture
def project(tmp_path, monkeypatch):
    """A folder with the project's settings, as the current one."""
    shutil.copytree(ROOT / "config", tmp_path / "config")
    shutil.copy(ROOT / "Snakefile", tmp_path)
    monkeypatch.chdir(tmp_path)
    return tmp_path


def overlay(folder: Path, **settings) -> str:
    file = folder / "overlay.yaml"
    file.write_text(yaml.safe_dump(settings))
    return str(file)


@core
def test_the_shipped_settings_have_no_problems(project, capsys):
    for name in (
        "demo",
        "studies/three_chains",
        "studies/two_throws",
        "studies/paper_tables",
        "studies/next_experiment",
    ):
        assert main(["check", f"config/{name}.yaml"]) == 0, capsys.readouterr().out
    capsys.readouterr()
    assert main(["check", "config/paper.yaml", "config/studies/paper_stride4.yaml"]) in (0, 1)
    assert all(
        "device: cuda" in line or "no problems" in line for line in capsys.readouterr().out.splitlines()
    )


@core
def test_a_new_scene_is_valid_and_named_in_the_next_commands(project, capsys):
    assert main(["new", "scene", "Mine"]) == 0
    assert "config/Mine.yaml -- results/Mine/film.mp4" in capsys.readouterr().out
    assert main(["check", "config/Mine.yaml"]) == 0
    assert main(["new", "scene", "Mine"]) == 1 and main(["new", "scene", "BouncyBall"]) == 1
    assert main(["new", "scene", "../up"]) == 1


@core
@pytest.mark.parametrize("inside", [False, True])
def test_a_new_scene_has_the_shape_of_a_mesh(project, capsys, tmp_path_factory, inside):
    folder = project / "models" if inside else tmp_path_factory.mktemp("elsewhere")
    folder.mkdir(exist_ok=True)
    trimesh.creation.cone(20, 50).export(folder / "my cup.stl")
    assert main(["new", "scene", "Cup", "--mesh", str(folder / "my cup.stl")]) == 0
    shape = yaml.safe_load((project / "config/Cup.yaml").read_text())["scenes"]["Cup"]["shape"]
    assert shape == ("models/my cup.stl" if inside else "meshes/Cup.stl")
    assert (project / shape).read_bytes() == (folder / "my cup.stl").read_bytes()
    capsys.readouterr()
    assert main(["check", "config/Cup.yaml"]) == 0, capsys.readouterr().out


@core
def test_a_new_scene_of_a_wrong_mesh_is_not_written(project, capsys):
    Path("cup.stl").write_text("no mesh")
    for file in ("cup.stl", "missing.obj", "config/config.yaml"):
        assert main(["new", "scene", "Cup", "--mesh", file]) == 1
        assert file in capsys.readouterr().err
    assert not Path("config/Cup.yaml").exists() and not Path("meshes").exists()


@core
@pytest.mark.parametrize(
    ("changes", "problem"),
    [
        ({}, None),
        ({"shape": "rod.glb"}, "does not exist"),
        ({"size": None}, "outside the box"),  # the file is in millimetres
        ({"height": 0.1}, "below the floor"),
        ({"spin": [0, 300, 0]}, "crosses a grid cell"),
        ({"law": {"elasticity": {"E": 3e7}}}, "Courant"),
    ],
)
def test_check_examines_a_mesh(project, capsys, changes, problem):
    trimesh.creation.box((100.0, 300.0, 50.0)).export("rod.obj")
    scene = {"like": "JellyDuck", "shape": "rod.obj", **changes}
    assert main(["check", overlay(project, scenes={"Rod": scene})]) == (problem is not None)
    out = capsys.readouterr().out
    assert problem is None or (problem in out and out.startswith("scenes.Rod.")), out
    Path("below").mkdir()
    with contextlib.chdir("below"):  # the path is relative to the project's folder
        assert main(["check", str(project / "overlay.yaml")]) == (problem is not None)


@core
def test_a_new_capture_is_valid_and_becomes_a_scene(project, capsys, monkeypatch):
    assert main(["new", "capture", "mug"]) == 0
    names = {"capture.yaml", "photos", "stills", "videos"}
    assert {p.name for p in (project / "captures/mug").iterdir()} == names
    assert main(["check"]) == 0 and main(["check", "captures/mug/capture.yaml"]) == 0
    with monkeypatch.context() as inside:
        inside.chdir("captures/mug")
        assert main(["check", "capture.yaml"]) == 0
    assert main(["new", "capture", "mug"]) == 1
    (project / "captures/mug/capture.yaml").write_text("board: {square: -1}\n")
    capsys.readouterr()
    assert main(["check"]) == 1
    assert "board.square" in capsys.readouterr().out
    (project / "captures/mug/capture.yaml").write_text("board: {square: 0.03}\nprior: jely\n")
    assert main(["check"]) == 1
    assert "scenes.mug.prior: no prior 'jely'" in capsys.readouterr().out
    (project / "captures/mug").rename(project / "captures/figures")
    assert main(["check"]) == 1
    assert "captures/figures: this name is reserved" in capsys.readouterr().out


@core
@pytest.mark.parametrize(
    ("scene", "where"),
    [
        ({"hieght": 1}, "scenes.JellyDuck.hieght"),
        ({"shape": "duk"}, "scenes.JellyDuck.shape"),
        ({"height": 0.1}, "scenes.JellyDuck.height"),
        ({"center": [0.9, 0.5]}, "scenes.JellyDuck.center"),
        ({"velocity": [0, -60, 0]}, "scenes.JellyDuck.velocity"),
        ({"spin": [0, 300, 0]}, "scenes.JellyDuck.velocity"),
        ({"velocity": [0, 0, 0], "steps": 100}, "scenes.JellyDuck.steps"),
        ({"law": {"elasticity": {"E": -1}}}, "scenes.JellyDuck.law.elasticity.E"),
        ({"law": {"elasticity": {"name": "jelly"}}}, "scenes.JellyDuck.law.elasticity.name"),
        ({"law": {"plasticity": {"name": "von_mises"}}}, "scenes.JellyDuck.law.plasticity.yield_stress"),
        ({"law": {"elasticity": {"E": 3e7}}}, "scenes.JellyDuck.law"),
        ({"density": 1.0}, "scenes.JellyDuck.prior = jelly"),
    ],
)
def test_check_names_each_problem(project, capsys, scene, where):
    assert main(["check", overlay(project, scenes={"JellyDuck": scene})]) == 1
    out = capsys.readouterr().out.splitlines()
    assert any(line.startswith(f"{where}:") for line in out), out


@core
@pytest.mark.parametrize(
    ("settings", "where"),
    [
        ({"training": {"views": [7]}}, "training.views"),
        ({"evaluation": {"views": [-1]}}, "evaluation.views"),
        ({"scenes": {"JellyDuck": {"training": {"views": [7]}}}}, "scenes.JellyDuck.training.views"),
        ({"scenes": {"S": {"splat": "a.ply", "velocity": [0, -90, 0]}}}, "scenes.S.velocity"),
        (
            {
                "scenes": {"S": {"splat": "a.ply"}},
                "experiments": {"x": {"title": "x", "steps": 9, "bodies": [{"scene": "S", "shape": "ball"}]}},
            },
            "experiments.x.bodies.0",
        ),
        ({"results_root": ""}, "results_root"),
    ],
)
def test_check_names_problems_of_other_settings(project, capsys, settings, where):
    assert main(["check", overlay(project, **settings)]) == 1
    out = capsys.readouterr().out.splitlines()
    assert any(line.startswith(f"{where}:") for line in out), out


@core
@pytest.mark.parametrize(
    ("text", "problem"),
    [
        ("# nothing\n", "the file is empty"),
        ("scenes: [\n", "line 2, column 1"),
        ("scenes: {ClayCat: {}, ClayCat: {}}\n", "line 1, column 23: the key 'ClayCat' is in line 1 already"),
        ("- 1\n", "expected lines 'key: value'"),
    ],
)
def test_check_names_the_file_that_is_broken(project, capsys, text, problem):
    (project / "mine.yaml").write_text(text)
    assert main(["check", "mine.yaml"]) == 1
    (line,) = capsys.readouterr().out.splitlines()
    assert line.startswith("mine.yaml: ") and problem in line


@core
def test_check_names_all_problems_at_once(project, capsys):
    scenes = {"JellyDuck": {"height": 0.1, "velocity": [0, -60, 0]}, "BouncyBall": {"shape": "bal"}}
    priors = {"laws": {"sand": {"plasticity": {"friction_angle": 95}}}}
    assert main(["check", overlay(project, scenes=scenes, priors=priors)]) == 1
    out = capsys.readouterr().out
    for where in (
        "JellyDuck.height",
        "JellyDuck.velocity",
        "BouncyBall.shape",
        "sand.plasticity.friction_angle",
    ):
        assert where in out


@core
def test_check_reports_a_missing_gpu(project, capsys, monkeypatch):
    monkeypatch.setattr(checks, "gpus", lambda: 0)
    assert main(["check", overlay(project, device="cuda")]) == 1
    assert "no CUDA GPU" in capsys.readouterr().out
    monkeypatch.setattr(checks, "gpus", lambda: 1)
    monkeypatch.setattr(checks, "torch_version", lambda: "2.13.0+cu130")
    assert main(["check", overlay(project, device="cuda")]) == 0


@core
def test_commands_are_refused_outside_of_a_project(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    for words in (["check"], ["demo"], ["new", "scene", "Mine"]):
        assert main(words) == 1
        assert "not in a project" in capsys.readouterr().err


@core
def test_check_loads_no_torch(project):
    code = "import sys; from neuma_lib.cli import main; main(['check']); "
    code += "sys.exit(len({'torch', 'warp'} & {*sys.modules}))"
    subprocess.run([sys.executable, "-c", code], check=True, env={"PYTHONPATH": str(ROOT), "PATH": ""})


def chosen(project, kind, **settings):
    """A folder of results of the duck with one chosen experiment."""
    folder = project / "results" / "JellyDuck"
    folder.mkdir(parents=True)
    write_json(folder / "next.json", {"candidates": [{"kind": kind, "settings": settings}]})
    return folder


@core
def test_a_chosen_launch_becomes_a_scene_of_the_same_material(project, capsys):
    launch = {"height": 0.5, "velocity": [0.0, -2.0, 0.0], "spin": [0.0, 1.0, 0.0], "steps": 256}
    folder = chosen(project, "launch", **launch)
    assert main(["new", "scene", "Second", "--from", "results/JellyDuck"]) == 0
    assert "--configfile config/Second.yaml -- results/JellyDuck/identified.json" in capsys.readouterr().out
    assert main(["check", "config/Second.yaml"]) == 0, capsys.readouterr().out
    settings, _ = Project.find(project, ["config/Second.yaml"])
    assert settings.video_scenes("JellyDuck") == ["JellyDuck", "Second"]
    scene = settings.scene("Second")
    assert scene.height == 0.5 and scene.velocity == (0.0, -2.0, 0.0) and scene.steps == 256
    assert scene.law == settings.scene("JellyDuck").law
    assert main(["new", "scene", "Third", "--from", str(folder), "--rank", "2"]) == 1
    assert main(["new", "scene", "Third", "--from", "results/ClayCat"]) == 1
    assert "neuma next" in capsys.readouterr().err


@core
def test_a_chosen_press_or_hang_becomes_a_scene_with_its_own_obstacles(project, capsys):
    """A press keeps the obstacles of the scene. A launch after a hang has no clamp."""
    still = [0.0, 0.0, 0.0]
    rest = {"height": 0.3, "center": [0.5, 0.5], "velocity": still, "spin": still, "steps": 256}
    platen = {"shape": "box", "size": [0.2, 0.02, 0.2], "keyframes": [[0.0, [0.5, 0.8, 0.5], still]]}
    ramp = {"shape": "plane", "centre": [0.5, 0.05, 0.5], "axis": [0.3, 1.0, 0.0]}
    clamp = {"lowest": [0.2, 0.4, 0.2], "highest": [0.8, 0.6, 0.8], "release": 0.1}
    folder = chosen(project, "press", **rest, colliders=[platen])
    duck = yaml.safe_dump({"scenes": {"JellyDuck": {"colliders": [ramp]}}})
    (project / "config" / "ramp.yaml").write_text(duck)
    settings, root = Project.find(project, ["config/ramp.yaml"])
    press = next_scene(root, "Press", settings, folder)
    write_json(
        folder / "next.json", {"candidates": [{"kind": "hang", "settings": rest | {"clamps": [clamp]}}]}
    )
    hang = next_scene(root, "Hang", settings, folder)
    both, _ = Project.find(project, ["config/ramp.yaml", press])
    assert [own["shape"] for own in both.obstacles("Press")["colliders"]] == ["plane", "box"]
    assert both.obstacles("JellyDuck")["colliders"] == both.obstacles("Press")["colliders"][:1]
    held, _ = Project.find(project, ["config/ramp.yaml", hang])
    assert held.obstacles("Hang")["clamps"] == [clamp] and held.video_scenes("JellyDuck")[1:] == ["Hang"]
    first = held.model_copy(update={"scenes": held.scenes | {"JellyDuck": held.scenes["Hang"]}})
    write_json(folder / "next.json", {"candidates": [{"kind": "launch", "settings": rest}]})
    assert (
        yaml.safe_load(next_scene(root, "Free", first, folder).read_text())["scenes"]["Free"]["clamps"] == []
    )


@core
def test_a_chosen_camera_is_a_further_view(project, capsys):
    chosen(project, "camera", view=4, azimuth=72, elevation=25)
    assert main(["new", "scene", "Side", "--from", "results/JellyDuck"]) == 0
    settings, _ = Project.find(project, ["config/Side.yaml"])
    assert settings.identify.views == (0, 4) and settings.dataset.dynamic.views == 5


@core
def test_the_next_experiment_of_an_unknown_material_is_refused(project, capsys):
    (project / "results" / "JellyDuck").mkdir(parents=True)
    assert main(["next", "results/JellyDuck"]) == 1
    assert "snakemake --cores 2 results/JellyDuck/identified.json" in capsys.readouterr().err
    assert main(["next", "results/Unknown"]) == 1
