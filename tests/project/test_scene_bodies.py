"""Scenes of several bodies in the settings."""

import pytest
import yaml

from neuma_lib.io.simulator import simulator
from neuma_lib.project import checks
from neuma_lib.project.cases import body_cases, case
from neuma_lib.project.find import scene_files
from neuma_lib.project.loading import merged
from neuma_lib.sim.bodies import Pair
from tests.conftest import ROOT
from tests.support.errors import refused

PILE = yaml.safe_load((ROOT / "config" / "pile.yaml").read_text())["scenes"]["Pile"]


@pytest.fixture
def with_pile(changed):
    """Settings with the shipped pile and changes of it."""

    def settings(changes=None, scenes=None, **others):
        return changed(scenes={"Pile": merged(PILE, changes or {}), **(scenes or {})}, **others)

    return settings


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


def test_each_body_has_a_scene(with_pile):
    settings = with_pile(advanced={"scenes.Pile.friction": 0.4})
    assert settings.body_scenes("Pile+seed=1") == [f"Pile_{name}+seed=1" for name in PILE["bodies"]]
    duck = settings.scenes["Pile_duck"]
    assert duck.has_truth and duck.part_of == ("Pile", "duck") and duck.friction == 0.4
    assert duck.law == settings.scenes["Pile"].bodies["duck"].law and duck.steps == PILE["steps"]
    assert settings.obstacles("Pile_duck") == {"boundary": 0.4, "contact": "particles"}
    assert "Pile_duck" not in settings.plain_scenes
    with refused("scenes.Pile.bodies.duck"):
        with_pile(scenes={"Pile_duck": {"like": "ClayCat"}})


def test_bodies_of_a_pile_touch_each_other_in_experiments(with_pile):
    names = ["ball", "fish"]
    bodies = [{"scene": f"Pile_{name}"} for name in names]
    settings = with_pile(
        experiments={
            "without_duck": {"title": "X", "bodies": bodies, "steps": 9},
            "with_cat": {"title": "X", "bodies": [*bodies, {"scene": "ClayCat"}], "steps": 9},
        }
    )
    assert settings.touching_bodies("without_duck") == ("Pile", names)
    assert settings.obstacles("without_duck")["pairs"] == [{"first": 0, "second": 1, "friction": 0.5}]
    assert settings.touching_bodies("with_cat") == (None, []) and "pairs" not in settings.obstacles(
        "with_cat"
    )


def test_a_pile_has_no_material_of_its_own(with_pile, changed):
    """No method, experiment or scene of several videos takes it."""
    with refused("Pile/neuma", remedy="Pile_fish, Pile_duck, Pile_ball"):
        case(with_pile(), "Pile", "neuma")
    body = {"scene": "Pile", "shape": "ball", "height": 0.5}
    with refused("experiments.x.bodies.0.scene"):
        with_pile(experiments={"x": {"title": "X", "bodies": [body], "steps": 9}})
    with refused("scenes.ClayCat.videos"):
        changed(scenes={"Pile": PILE, "ClayCat": {"videos": ["Pile"]}})


def test_files_of_a_pile_for_the_viewer(with_pile):
    """Its motion follows from several laws, and its bodies are identified in one file."""
    files = scene_files(with_pile(), "Pile", ["constants"])
    assert files.truth == "data/Pile/truth.h5" and files.binding == "results/Pile/binding.h5"
    (run,) = files.runs
    assert run.law is None and run.gaussian_motion == "affine"
    bodies = body_cases(with_pile(), "Pile", "constants")
    assert [
        (whole.result("identified.json"), name) for whole, name in (body.together for body in bodies)
    ] == [("results/Pile/identified.json", name) for name in PILE["bodies"]]
    (alone,) = body_cases(with_pile(), "Pile_duck", "constants")
    assert alone.together is None
