"""Colliders in the settings: errors name the entry, and all simulations of a scene see the same obstacles."""

import json

import numpy as np
import pytest
import torch
import trimesh

from neuma_lib.config import obstacles
from neuma_lib.config.obstacles import ColliderConfig
from neuma_lib.io.simulator import simulator
from neuma_lib.project import checks
from neuma_lib.project.cases import case
from neuma_lib.project.find import scene_files
from neuma_lib.sim.clamps import Clamp
from neuma_lib.sim.colliders import SIZES, Collider
from tests.support.errors import refused

STEP = {"shape": "box", "size": [0.2, 0.05, 0.5], "centre": [0.8, 0.05, 0.5], "friction": 0.5}


@pytest.fixture
def with_colliders(changed):
    """Settings with a scene like BouncyBall with some colliders."""
    return lambda *colliders, **others: changed(
        scenes={"Steps": {"like": "BouncyBall", "colliders": list(colliders)}}, **others
    )


WRONG = {
    "shape": [{"shape": "bxo"}, {"shape": "mesh"}],
    "size": [
        {"size": [0.1]},
        {"size": [0.1, 0.1, -0.1]},
        {"shape": "plane"},
        {"shape": "sphere"},
        {"shape": "a.obj", "size": []},
    ],
    "axis": [{"axis": [0, 0, 0]}, {"axis": [1, 0, 0], "rotation": [1, 0, 0]}],
    "friction": [{"friction": -1}],
    "damping": [{"damping": 2}],
    "keyframes": [{"keyframes": [[0, [0, 0, 0], [0, 0, 0]]]}],
}


@pytest.mark.parametrize("key, change", [(key, change) for key in WRONG for change in WRONG[key]])
def test_wrong_entries_are_named(with_colliders, key, change):
    with refused(f"scenes.Steps.colliders.1.{key}"):
        with_colliders(STEP, STEP | change)


def test_key_frames_ascend(with_colliders):
    poses = [[time, [0.8, 0.05, 0.5], [0, 0, 0]] for time in (0, 1, 1)]
    moving = {"shape": "sphere", "size": [0.1], "keyframes": poses}
    with refused("scenes.Steps.colliders.0.keyframes"):
        with_colliders(moving)
    moving["keyframes"] = poses[:2]
    (settings,) = with_colliders(moving).obstacles("Steps")["colliders"]
    assert Collider(**settings).pose(0.5)[1].tolist() == [0.8, 0.05, 0.5]


def test_shapes_are_those_of_the_simulator():
    assert {shape: SIZES[shape] for shape in obstacles.LENGTHS} == obstacles.LENGTHS


def test_an_axis_is_a_rotation_of_the_y_axis():
    """Directions of all octants, and the y axis itself in both directions, for which the axis of rotation is free."""
    directions = [*np.random.default_rng(0).normal(size=(20, 3)).tolist(), [0, 2, 0], [0, -1, 0], [1, 0, 0]]
    for axis in directions:
        entry = ColliderConfig(shape="plane", axis=axis)
        _, normal = Collider(**entry.arguments()).surface(torch.zeros(3, dtype=torch.float64))
        np.testing.assert_allclose(normal, np.array(axis) / np.linalg.norm(axis), atol=1e-12)


def test_scenes_with_obstacles_have_contact_of_particles(changed):
    scenes = {"Steps": {"like": "BouncyBall", "colliders": [STEP]}}
    settings = changed(simulation={"contact": "released"}, scenes=scenes)
    contacts = [scene_files(settings, name, []).simulation["contact"] for name in ("Steps", "BouncyBall")]
    assert contacts == ["particles", "released"]


def test_a_random_scene_may_have_another_friction(changed):
    """Of the faces of the cube in its simulations, also those of experiments with it."""
    study = {"random.friction": [0.3, 0.3]}
    settings = changed(random={"count": 2}, simulation={"contact": "nodes"}, advanced=study)
    known, (name, _) = settings.simulation.plain(), settings.random_scenes
    falls = {"falls": {"title": "", "bodies": [{"scene": name}], "steps": 10}}
    settings = changed(
        random={"count": 2}, simulation={"contact": "nodes"}, experiments=falls, advanced=study
    )
    for own in (name, f"{name}+seed=1", "falls"):
        constants = {key: known[key] for key in ("grid", "gravity", "boundary", "contact")}
        model = simulator({"dt": 1e-3, **constants, **settings.obstacles(own)})
        assert set(model.frictions) == {0.3}
    assert changed(random={"count": 2}).obstacles(name) == {}
    for wrong in ([0.0, 0.3], [0.4, 0.3]):
        with refused("random.friction"):
            changed(advanced={"random.friction": wrong})


def test_videos_of_one_law_share_their_obstacles(with_colliders, changed):
    """Or have their own: the law is identified in all of them, but no correction is trained."""
    other = changed(scenes={"Steps": {"like": "BouncyBall", "videos": [{"colliders": [STEP]}]}})
    assert other.obstacles("Steps") == {} != other.obstacles("Steps_throw2")
    with refused("scenes.Steps.videos", problem="colliders"):
        case(other, "Steps", "neuma").each_video(lambda case: case.scene)
    again = changed(
        scenes={"Steps": {"like": "BouncyBall", "colliders": [STEP], "videos": [{"velocity": [0, 0, 1]}]}}
    )
    assert again.obstacles("Steps_throw2") == again.obstacles("Steps")


def test_experiments_have_their_own_obstacles_or_those_of_the_scene(with_colliders):
    body = {"scene": "Steps", "shape": "cat", "height": 0.5}
    plain = {"title": "x", "bodies": [body], "steps": 10}
    sphere = {"shape": "sphere", "size": [0.1], "centre": [0.1, 0.1, 0.1]}
    settings = with_colliders(
        STEP, experiments={"a": plain, "b": plain | {"colliders": [sphere]}, "c": plain | {"colliders": []}}
    )
    assert settings.obstacles("a") == settings.obstacles("Steps+seed=1")
    assert settings.obstacles("b")["colliders"] == [sphere]
    assert settings.obstacles("c") == {} == settings.obstacles("ClayCat")
    files = scene_files(settings, "Steps", [])
    model = simulator(json.loads(json.dumps(files.simulation)))
    assert model.colliders == (
        Collider(**{k: tuple(v) if isinstance(v, list) else v for k, v in STEP.items()}),
    )
    with refused("experiments.d.colliders.0.size"):
        with_colliders(STEP, experiments={"d": plain | {"colliders": [STEP | {"size": []}]}})


@pytest.mark.parametrize(
    "collider",
    [
        {"shape": "box", "size": [0.2, 0.3, 0.1], "rotation": [0.3, 0.5, -0.2]},
        {"shape": "sphere", "size": [0.25]},
        {"shape": "capsule", "size": [0.2, 0.15], "axis": [1, 1, 0]},
        {"shape": "plane", "axis": [1, 2, 0]},
    ],
)
def test_a_body_inside_an_obstacle_is_a_problem(collider):
    """Equal to the sign of the simulator's distance."""
    entry = ColliderConfig(**collider, centre=[0.5, 0.4, 0.5])
    points = np.random.default_rng(1).uniform(size=(300, 3))
    distance, _ = Collider(**entry.arguments()).surface(torch.from_numpy(points))
    contained = [checks._contains(entry, point) for point in points]
    assert 0 < sum(contained) < 300
    np.testing.assert_array_equal(contained, distance < 0)


def test_problems_of_obstacles_are_named(with_colliders, tmp_path):
    around = STEP | {"centre": [0.5, 0.5, 0.5], "size": [0.4, 0.4, 0.4]}
    body = {"scene": "ClayCat", "shape": "cat", "height": 0.5}
    experiments = {"x": {"title": "x", "bodies": [body], "steps": 10, "colliders": [STEP, around]}}
    missing = {"shape": "none.stl", "size": [0.1]}
    first, second, third = checks.problems(with_colliders(around, missing, experiments=experiments))
    assert first.startswith("scenes.Steps.colliders.1.shape: no file none.stl")
    assert second.startswith("scenes.Steps.colliders.0: the box contains")
    assert third.startswith("experiments.x.colliders.1: the box contains")
    file = tmp_path / "ball.stl"
    ball = trimesh.creation.icosphere(3, radius=7.0).apply_translation([1, 2, 3])
    ball.export(file)
    assert not checks.problems(with_colliders(STEP, {"shape": str(file), "size": [0.1]}))
    mesh = {"shape": str(file), "size": [0.4], "centre": [0.5, 0.5, 0.5], "friction": 0.3}
    (collider,) = simulator({"grid": 8, "dt": 1e-3, "contact": "particles", "colliders": [mesh]}).colliders
    distance, _ = collider.surface(torch.tensor([[0.72, 0.5, 0.5], [0.5, 0.5, 0.4]], dtype=torch.float64))
    # facets are up to 1 % of the radius inside the ball, and distances are those of a grid of 7 mm
    np.testing.assert_allclose(distance, [0.02, -0.1], atol=0.004)
    assert collider.friction == 0.3


def test_clamps_are_those_of_the_simulator(changed):
    clamp = {
        "lowest": [0, 0.5, 0],
        "highest": [1, 1, 1],
        "release": 0.1,
        "keyframes": [[0, [0, 0, 0], [0, 0, 0]]],
    }
    held = {"like": "BouncyBall", "velocity": [0, 0, 0], "clamps": [clamp, {**clamp, "release": None}]}
    settings = changed(scenes={"Held": held})
    first, second = simulator(scene_files(settings, "Held", []).simulation).clamps
    assert first == Clamp((0, 0.5, 0), (1, 1, 1), 0.1, keyframes=((0, (0, 0, 0), (0, 0, 0)),))
    assert second.release == np.inf
    for wrong in ({"highest": [1, 0.5, 1]}, {"release": 0}, {"keyframes": 2 * clamp["keyframes"]}):
        with refused(f"scenes.Held.clamps.0.{next(iter(wrong))}"):
            changed(scenes={"Held": held | {"clamps": [clamp | wrong]}})
    with refused("scenes.Held", problem="starts at rest"):
        changed(scenes={"Held": held | {"spin": [0, 1, 0]}})
