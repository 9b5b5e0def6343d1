"""Scenes of several bodies in the settings."""

import pytest
import yaml

from neuma_lib.io.simulator import simulator
from neuma_lib.project import checks
from neuma_lib.project.loading import merged
from neuma_lib.project.paths import result_path
from neuma_lib.sim.bodies import Pair
from tests.conftest import ROOT
from tests.support.errors import refused

PILE = yaml.safe_load((ROOT / "config" / "pile.yaml").read_text())["scenes"]["Pile"]


@pytest.fixture
def with_pile(changed):
    """Settings with the shipped pile and changes of it."""
    return lambda changes=None, **others: changed(scenes={"Pile": merged(PILE, changes or {})}, **others)


def test_bodies_and_pairs_reach_the_simulator(with_pile):
    settings = with_pile(
        {"pairs": [{"bodies": ["ball", "fish"], "friction": 0.2}, {"bodies": ["fish", "duck"]}]}
    )
    names = [body["name"] for body in settings.scene_bodies("Pile")]
    assert names == ["fish", "duck", "ball"]
    model = simulator({"grid": 16, "dt": 1e-3, **settings.obstacles("Pile")})
    assert model.pairs == (Pair(0, 2, 0.2), Pair(0, 1)) and model.contact == "particles"
    assert settings.scene_bodies("ClayCat")[0]["shape"] == "cat"
    assert "Pile" not in settings.plain_scenes and not checks.problems(settings)


WRONG = {
    "shape": {"shape": "ball"},
    "law": {"law": PILE["bodies"]["fish"]["law"]},
    "bodies: 6": {"bodies": {f"b{k}": PILE["bodies"]["ball"] for k in range(3)}},
    "pairs: each": {"pairs": [{"bodies": ["fish", "cat"]}]},
    "pairs: two": {"pairs": [{"bodies": ["fish", "duck"]}, {"bodies": ["duck", "fish"]}]},
    "clamps": {"clamps": [{"lowest": [0, 0, 0], "highest": [1, 0.1, 1]}]},
    "images": {"images": {"dynamic": "mine/transforms.json"}},
}


@pytest.mark.parametrize("text", WRONG)
def test_wrong_scenes_are_refused(with_pile, text):
    with refused(problem=text):
        with_pile(WRONG[text])


def test_pairs_need_bodies(changed):
    with refused(problem="pairs"):
        changed(scenes={"Alone": {"like": "ClayCat", "pairs": [{"bodies": ["a", "b"]}]}})


def test_a_pile_is_not_reconstructed(with_pile, changed):
    """Nor does an experiment or a scene of several videos take its material."""
    with refused("scenes.Pile.bodies", remedy="data/Pile"):
        result_path(with_pile(), "Pile", "gaussians.ply")
    body = {"scene": "Pile", "shape": "ball", "height": 0.5}
    with refused("experiments.x.bodies.0.scene"):
        with_pile(experiments={"x": {"title": "X", "bodies": [body], "steps": 9}})
    with refused("scenes.ClayCat.videos"):
        changed(scenes={"Pile": PILE, "ClayCat": {"videos": ["Pile"]}})
