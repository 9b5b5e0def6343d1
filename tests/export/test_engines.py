"""Exported files in the engines themselves, where these are installed (extra ``engines``; Genesis with GENESIS=1)."""

import json
import os
import re
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

import neuma_lib as nm
from benchmarks import engine_schemes
from neuma_lib.cli import main
from neuma_lib.evaluation.material_point import returned, stress
from neuma_lib.export.materials import RULES, engine_material
from neuma_lib.export.scenes import STICKS, EngineScene, export_scene
from neuma_lib.io.exported import about_law
from neuma_lib.io.laws import load_law, save_law
from neuma_lib.mechanics.analytic import analytic_law
from neuma_lib.sim.colliders import Collider
from tests.export.test_materials import RHO, spec_of
from tests.support.blends import needs_blender
from tests.support.errors import refused
from tests.support.viewer_project import make_project

ROOT = Path(__file__).resolve().parents[2]
DT = 5e-4
CELL, SPACING, SIDE = 0.025, 0.0125, 12


def play(folder, *words):
    """Run the script of an exported folder, without this library, and return its motion."""
    environment = {key: value for key, value in os.environ.items() if key != "PYTHONPATH"} | {
        "OMP_NUM_THREADS": "1"
    }
    done = subprocess.run(
        [sys.executable, str(folder / "run.py"), *words], env=environment, cwd=folder, capture_output=True, text=True,
        timeout=900,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr[-2000:]
    with np.load(folder / "motion.npz") as motion:
        return motion["t"], motion["x"].astype(float)


def moving_cube(**changes):
    """A cube in free flight that stretches and shears."""
    sites = np.indices((SIDE,) * 3).reshape(3, -1).T - (SIDE - 1) / 2
    x = sites * SPACING
    v = x @ np.array([[0.0, 1.0, 0.0], [0.0, -0.6, 0.4], [-0.8, 0.0, 0.6]]).T
    vol0 = np.full(len(x), SPACING**3)
    fields = dict(dt=DT, steps=20, every=20, grid=40, friction=0.0, **changes)
    return EngineScene(x + 0.5, v, RHO * vol0, vol0, **fields)


def our_motion(scene, spec):
    x, v, mass, vol0 = (torch.from_numpy(each) for each in (scene.x, scene.v, scene.mass, scene.vol0))
    law, frames = nm.Law.from_spec(spec, scene.dt), range(0, scene.steps + 1, scene.every)
    return nm.simulate(
        nm.MPM(scene.grid, scene.dt, scene.gravity), law, nm.State(x, v, mass, vol0), frames
    ).x.numpy()


# newton


def newton_state(spec, F, dt):
    """Kirchhoff stress of newton in the core of a cube with the uniform elastic F after one step, and its elastic F."""
    newton, wp = pytest.importorskip("newton"), pytest.importorskip("warp")
    from newton.solvers import SolverImplicitMPM

    builder = newton.ModelBuilder(up_axis=newton.Axis.Y, gravity=(0.0, 0.0, 0.0))
    SolverImplicitMPM.register_custom_attributes(builder)
    x = (np.indices((SIDE,) * 3).reshape(3, -1).T - (SIDE - 1) / 2) * SPACING
    material = engine_material(spec, RHO, dt, "newton").arguments
    builder.add_particles(
        pos=[wp.vec3(*point) for point in x.tolist()],
        vel=[wp.vec3(0.0, 0.0, 0.0)] * len(x),
        mass=[RHO * SPACING**3] * len(x),
        radius=[SPACING / 2] * len(x),
        custom_attributes={f"mpm:{name}": [value] * len(x) for name, value in material.items()},
    )
    model = builder.finalize(device="cpu")
    config = SolverImplicitMPM.Config(voxel_size=CELL, air_drag=0.0, tolerance=1e-8, max_iterations=2000)
    state = model.state()
    state.mpm.particle_elastic_strain.assign(np.tile(F.astype(np.float32), (len(x), 1, 1)))
    SolverImplicitMPM(model, config).step(state, state, None, None, dt)
    core = (np.abs(x) < CELL).all(axis=1)
    values = (state.mpm.particle_stress, state.mpm.particle_elastic_strain)
    own, elastic = (each.numpy()[core].mean(axis=0).astype(float) for each in values)
    return -own, elastic  # newton's pressure is positive


@pytest.mark.parametrize("names", [names for names in RULES["newton"]], ids=" + ".join)
def test_stress_of_newton_is_that_of_our_law(names):
    """Viscous stress is not stored. It follows from the elastic strain, which newton updates to first order."""
    viscous, size = "viscous" in names[1], 1e-3 if "viscous" in names[1] or names[0] == "fluid" else 0.06
    F = np.eye(3) + size * np.random.default_rng(0).standard_normal((3, 3))
    J = 1.0 if names[1] in ("identity", "von_mises") or viscous else 1 - 0.5 * size
    F *= (J / np.linalg.det(F)) ** (1 / 3)
    spec = spec_of(*names, **({"yield_stress": 10.0} if viscous else {}))
    law, dt = analytic_law(spec, 1e-4), 1e-4
    own, elastic = newton_state(spec, F, dt)
    trial = torch.from_numpy(F)[None]
    ours = stress(law, returned(law, trial))[0].numpy()
    theirs = stress(law, torch.from_numpy(elastic)[None])[0].numpy() if viscous else own
    assert np.linalg.norm(theirs - ours) < (2e-3 if size == 1e-3 else 1e-5) * np.linalg.norm(ours)


def test_newton_imports_the_material_and_body_of_a_law_file(tmp_path):
    newton = pytest.importorskip("newton")
    pytest.importorskip("newton_usd_schemas")
    from newton.solvers import SolverImplicitMPM
    from pxr import Usd

    spec = spec_of("hencky", "von_mises")
    law = analytic_law(spec)
    save_law(tmp_path / "law.safetensors", law, about_law(law, DT, density=RHO))
    file = str(tmp_path / "clay.usda")
    assert main(["law", "export", str(tmp_path / "law.safetensors"), file, "--engine", "usd"]) == 0
    builder = newton.ModelBuilder(up_axis=newton.Axis.Y)
    stage = Usd.Stage.Open(file)
    imported = builder.add_usd(stage, load_visual_shapes=False)
    model = builder.finalize(device="cpu")
    for name, value in engine_material(spec, RHO, DT, "newton").arguments.items():
        np.testing.assert_allclose(getattr(model.mpm, name).numpy(), value, rtol=1e-6)
    assert model.particle_count == 16**3
    assert model.particle_mass.numpy().sum() == pytest.approx(RHO * 0.2**3, rel=1e-5)
    config = SolverImplicitMPM.Config.create_from_usd(stage.GetPrimAtPath(imported["particle_scene_path"]))
    assert config.voxel_size == pytest.approx(CELL) and config.air_drag == 0
    assert model.shape_count == 1  # the floor
    assert main(["law", "import", file, str(tmp_path / "again.safetensors")]) == 0
    F = torch.eye(3, dtype=torch.float64) + 0.1 * torch.randn(20, 3, 3, dtype=torch.float64)
    again = load_law(tmp_path / "again.safetensors")
    torch.testing.assert_close(
        stress(again, returned(again, F)), stress(law, returned(law, F)), rtol=1e-6, atol=0.1
    )


def test_newton_moves_a_cube_in_flight_as_this_library(tmp_path):
    pytest.importorskip("newton")
    pytest.importorskip("newton_usd_schemas")
    spec = spec_of("hencky")
    scene = moving_cube()
    export_scene(tmp_path, "newton", scene, spec, {})
    _, x = play(tmp_path)
    ours = our_motion(scene, spec)
    moved = np.linalg.norm(ours[-1] - ours[-1].mean(0) - ours[0] + ours[0].mean(0), axis=1)
    difference = np.linalg.norm(x[-1] - ours[-1], axis=1)
    assert np.sqrt(np.mean(difference**2)) < 0.03 * np.sqrt(np.mean(moved**2))


@needs_blender
def test_blender_reads_the_coloured_particles(tmp_path):
    scene = moving_cube(colors=np.random.default_rng(0).random((SIDE**3, 3)))
    export_scene(tmp_path, "newton", scene, spec_of("hencky"), {})
    code = (
        "import bpy, sys; bpy.ops.wm.read_factory_settings(use_empty=True);"
        "bpy.ops.wm.usd_import(filepath=sys.argv[1]);"
        "(o,) = [o for o in bpy.data.objects if o.type == 'POINTCLOUD'];"
        "a = o.data.attributes['displayColor'].data; print(len(o.data.points), *a[5].color[:3])"
    )
    done = subprocess.run(
        [sys.executable, "-c", code, str(tmp_path / "scene.usda")], capture_output=True, text=True
    )
    count, *color = done.stdout.splitlines()[-1].split()
    assert int(count) == SIDE**3
    np.testing.assert_allclose(np.array(color, float), scene.colors[5], atol=1e-3)


# MuJoCo


@pytest.mark.parametrize("stretch", [0.7, 0.8, 0.9, 1.05, 1.2])
def test_end_force_of_mujoco_is_that_of_our_law(tmp_path, monkeypatch, stretch):
    mujoco = pytest.importorskip("mujoco")
    monkeypatch.chdir(tmp_path)  # MuJoCo writes its log there
    spec = spec_of("stvk")
    export_scene(tmp_path, "mujoco", EngineScene.falling_cube(RHO, DT), spec, {})
    model = mujoco.MjModel.from_xml_path(str(tmp_path / "scene.xml"))
    data = mujoco.MjData(model)
    x = model.body_pos[1:]
    data.qpos[:] = ((stretch - 1) * (x - x.min(axis=0)) * [1, 0, 0]).ravel()
    mujoco.mj_forward(model, data)
    top = x[:, 0] > x[:, 0].max() - 1e-9
    force = data.qfrc_passive.reshape(-1, 3)[top, 0].sum()
    F = torch.diag(torch.tensor([stretch, 1.0, 1.0], dtype=torch.float64))[None]
    ours = -float(nm.Law.from_spec(spec).first_piola(F)[0, 0, 0]) * 0.2**2
    assert force == pytest.approx(ours, rel=1e-8)


def test_mujoco_plays_a_fall(tmp_path):
    pytest.importorskip("mujoco")
    scene = replace(EngineScene.falling_cube(RHO, DT), steps=100, every=50)
    export_scene(tmp_path, "mujoco", scene, spec_of("stvk"), {})
    t, x = play(tmp_path)
    fallen = 0.5 * 9.8 * t**2 + 0.5 * 9.8 * DT * t  # symplectic Euler
    np.testing.assert_allclose((x[0] - x)[:, :, 1], np.broadcast_to(fallen[:, None], x.shape[:2]), atol=1e-6)


@pytest.mark.parametrize("friction", [0.0, STICKS])
def test_mujoco_stops_a_ball_at_the_floor(tmp_path, friction):
    pytest.importorskip("mujoco")
    scene = EngineScene.falling_cube(RHO, DT)
    inside = np.linalg.norm(scene.x - scene.x.mean(axis=0), axis=1) < 0.1
    arrays = {name: getattr(scene, name)[inside] for name in ("x", "v", "mass", "vol0")}
    scene = replace(scene, **arrays, friction=friction, steps=400, every=20)
    export_scene(tmp_path, "mujoco", scene, spec_of("stvk", E=1e5), {})
    _, x = play(tmp_path)
    assert -0.05 < x[:, :, 1].min() < 0.01  # soft contact of a few vertices first


# Genesis


@pytest.mark.skipif(not os.environ.get("GENESIS"), reason="Genesis compiles for minutes: set GENESIS=1")
@pytest.mark.parametrize("names", [names for names in RULES["genesis"]], ids=" + ".join)
def test_genesis_moves_a_cube_in_flight_as_this_library(tmp_path, names):
    pytest.importorskip("genesis")
    scene, spec = moving_cube(), spec_of(*names)
    scene = replace(scene, steps=200, every=200)  # 0.1 s
    export_scene(tmp_path, "genesis", scene, spec, {})
    _, x = play(tmp_path)
    difference = np.linalg.norm(x[-1] - our_motion(scene, spec)[-1], axis=1)
    limit = {"viscous_flow": 5e-4, "drucker_prager": 5e-5}.get(
        names[1], 1e-5
    )  # sand: volume correction of Genesis
    assert np.sqrt(np.mean(difference**2)) < limit


# Examples


def example(name, folder):
    """Numbers that an example prints in its last two lines."""
    environment = os.environ | {"PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"}
    command = [sys.executable, str(ROOT / "examples" / name)]
    done = subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True, timeout=900)
    assert done.returncode == 0, done.stderr[-2000:]
    return [
        [float(n) for n in re.findall(r"-?[0-9.]+(?:e-?[0-9]+)?", line)]
        for line in done.stdout.splitlines()[-2:]
    ]


def test_the_example_of_mujoco_has_the_force_of_the_law(tmp_path):
    pytest.importorskip("mujoco")
    for _, theirs, ours in example("in_mujoco.py", tmp_path):
        assert theirs == ours != 0


@pytest.mark.slow
def test_the_example_of_newton_stops_at_the_floor(tmp_path):
    pytest.importorskip("newton_usd_schemas")
    for _, mean, lowest in example("in_newton.py", tmp_path):
        assert 20 < mean < 120 and -5 < lowest < 30


@pytest.mark.slow
def test_the_beam_of_finite_elements_sags_as_in_mpm(tmp_path):
    pytest.importorskip("skfem")
    (_, elements, particles), (percent,) = example("beam_in_scikit_fem.py", tmp_path)
    assert percent < 3 and elements < -20 and abs(particles / elements - 1) < 0.08


# Scenes


@pytest.mark.parametrize("names", [("hencky",), ("hencky", "von_mises")], ids=" + ".join)
def test_the_slow_scheme_with_our_choices_is_ours(names):
    scene, spec = replace(moving_cube(), steps=40, every=40), spec_of(*names)
    own = our_motion(scene, spec)
    x = engine_schemes.simulate(scene, analytic_law(spec, DT))
    assert np.abs(own[-1] - own[0]).max() > 1e-3
    np.testing.assert_allclose(x, own[-1], atol=1e-6)
    other = engine_schemes.simulate(scene, analytic_law(spec, DT), gradient=True, trilinear=True)
    assert np.abs(other - x).max() > 1e-5


@pytest.mark.core
def test_a_scene_file_states_everything(tmp_path):
    scene = moving_cube()
    for engine, names in {"genesis": ("neo_hookean",), "newton": ("hencky",), "mujoco": ("stvk",)}.items():
        folder = tmp_path / engine
        notes = export_scene(folder, engine, scene, spec_of(*names), {"scale": 0.5, "grid": 40})
        content = json.loads((folder / "scene.json").read_text())
        assert content["density"] == pytest.approx(RHO) and content["scale"] == 0.5 and content["dt"] == DT
        assert content["notes"] == notes and any("fitted on a grid of 40" in note for note in notes)
        assert content["law"] == spec_of(*names) and content["floor"] == {"friction": 0.0}
        compile((folder / "run.py").read_text(), "run.py", "exec")
        start = np.load(folder / "body.npz")
        assert start["v"].shape[1] == 3 and (folder / "run.py").read_text().count("\n") <= 60


@pytest.mark.core
def test_a_scene_with_what_an_engine_does_not_get_is_refused(tmp_path):
    cube, mpm = moving_cube(), nm.MPM(40, DT)
    x, vol0 = torch.from_numpy(cube.x), torch.from_numpy(cube.vol0)
    state = nm.State(x, torch.zeros(3).double(), RHO * vol0, vol0)
    with refused("scene.colliders"):
        EngineScene.of(replace(mpm, colliders=(Collider("sphere", (0.1,)),)), state, 10, 5)
    with refused("scene.start", problem="deformed"):
        EngineScene.of(mpm, replace(state, F=1.01 * state.F), 10, 5)
    own = EngineScene.of(replace(mpm, boundary={"y_min": 0.3}), state, 10, 5)
    assert own.friction == 0.3 and len(own.notes) == 1
    assert len(EngineScene.of(nm.MPM(40, DT, contact="nodes"), state, 10, 5).notes) == 2
    uneven = np.where(np.arange(len(own.x)) % 2, 1.0, 1.2)
    with refused("density", problem="not uniform"):
        export_scene(tmp_path, "newton", replace(own, mass=own.mass * uneven), spec_of("hencky"), {})
    with refused("particles", problem="standard deviation"):
        scene = replace(own, mass=own.mass * uneven**4, vol0=own.vol0 * uneven**4)
        export_scene(tmp_path, "genesis", scene, spec_of("neo_hookean"), {})
    with refused("law stvk + identity", remedy="mujoco can"):
        export_scene(tmp_path, "newton", own, spec_of("stvk"), {})
    assert not list(tmp_path.iterdir())


@pytest.mark.core
def test_a_filmed_scene_is_exported_with_the_constants_of_the_material(tmp_path, capsys):
    folder = make_project(tmp_path)
    identified = json.loads((folder / "identified.json").read_text())
    material = {"elasticity": {"name": "hencky", "E": 4e4, "nu": 0.3}}
    constants = {"E": {"value": 4e4, "log_std": 0.07}}
    identified |= {"grid": 24, "material": {"law": material, "constants": constants}}
    (folder / "identified.json").write_text(json.dumps(identified))
    out = tmp_path / "out"
    assert main(["scene", "export", str(folder / "constants"), str(out), "--engine", "newton"]) == 0
    assert f"Play it with: python {out}/run.py" in capsys.readouterr().out
    content = json.loads((out / "scene.json").read_text())
    assert content["arguments"]["young_modulus"] == 4e4 and content["constants"] == constants
    assert content["grid"] == 36 and content["grid_of_law"] is None  # that of the default settings
    assert content["scene"] == "BouncyBall" and content["steps"] == 30
    assert "constants of the material" in content["notes"]
    assert "primvars:displayColor" in (out / "scene.usda").read_text()
    assert main(["law", "export", str(folder / "constants"), str(out / "l.json"), "--engine", "newton"]) == 0
    assert json.loads((out / "l.json").read_text())["arguments"]["young_modulus"] == 4e4
    for source, engine, words in (
        (folder / "constants", "genesis", "newton can"),
        (folder / "nclaw", "newton", "no networks"),
        (folder / "constants", "unity", "must be one of"),
        (folder, "newton", "its motion follows from no material law"),
    ):
        capsys.readouterr()
        status = main(["scene", "export", str(source), str(tmp_path / "no"), "--engine", engine])
        error = capsys.readouterr().err
        assert status == 1 and error.count("\n") == 1, (source, error)
        assert words in error or source == folder, error
    assert main(["scene", "export", str(folder / "nclaw"), str(tmp_path / "fit"), "--engine", "newton", "--fit",
                 "--force"]) == 0  # fmt: skip
    assert "stress error of the fit" in capsys.readouterr().out
