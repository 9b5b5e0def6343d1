"""Random scenes of several bodies: all machines draw the same ones, they start apart, and every rejection occurs."""

from collections import Counter

import pytest

from neuma_lib.geometry.shapes import place
from neuma_lib.geometry.volume import check_apart
from neuma_lib.project import loading, random_piles
from neuma_lib.project.random_piles import REJECTIONS, draw_piles
from tests.conftest import ROOT
from tests.support.errors import refused

GRAVITY = (0.0, -9.8, 0.0)


@pytest.fixture(scope="module")
def study():
    raw = loading.merged(
        loading.read_yaml(ROOT / "config/config.yaml"), loading.read_yaml(ROOT / "config/studies/piles.yaml")
    )
    return loading.load(raw, ROOT)


def drawn(study, **changes):
    chosen = study.random.model_validate({**study.random.plain(), **changes})
    return draw_piles(chosen, study.priors.laws, study.simulation.grid, GRAVITY)


def test_bodies_have_different_shapes_and_laws_and_start_apart(study):
    scenes = {name: study.scene(name) for name in study.random_piles}
    assert len(scenes) == 20 and not study.random_scenes
    assert {len(scene.bodies) for scene in scenes.values()} == {2, 3, 4}
    for scene in scenes.values():
        laws = [str(body.law.plain()) for body in scene.bodies.values()]
        assert list(scene.bodies) == [body.shape for body in scene.bodies.values()] and len({*laws}) == len(
            laws
        )
        assert len(scene.pairs) == len(laws) * (len(laws) - 1) / 2
        assert all(0.1 <= pair.friction <= 0.8 for pair in scene.pairs)
    for scene in list(scenes.values())[:1]:
        meshes = [place(body.shape, body.size, body.height, body.center) for body in scene.bodies.values()]
        check_apart(meshes)
        assert all((mesh.bounds > 0).all() and (mesh.bounds < 1).all() for mesh in meshes)


def test_a_scene_depends_on_the_seed_and_its_number(study):
    few, many = drawn(study, count=3), drawn(study, count=5)
    assert few.items() <= many.items() and drawn(study, count=3) == few
    assert drawn(study, count=3, seed=2).values() != few.values()


def test_every_scene_has_an_experiment_without_its_first_body(study):
    for name in study.random_piles:
        first, *others = study.body_scenes(name)
        rest = study.experiment(f"{name}_rest")
        assert [body.scene for body in rest.bodies] == others and first not in others
        assert rest.steps == study.scene(name).steps


def test_reasons_to_reject_occur(study, monkeypatch):
    seen, evaluate = Counter(), random_piles._rejection
    monkeypatch.setattr(
        random_piles, "_rejection", lambda *given: (reason := evaluate(*given), seen.update([reason]))[0]
    )
    drawn(study, count=10)
    assert {*seen} == {None, *REJECTIONS} - {"unstable"}
    with refused("random", problem="next to 0 bodies"):
        drawn(study, size=(0.98, 1.0))
    with refused("random", problem="shorter time step"):
        drawn(study, dt=(0.1,))
