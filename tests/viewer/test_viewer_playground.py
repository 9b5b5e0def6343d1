"""The playground of a reconstructed body: laws, Gaussians and added bodies."""

import threading

import pytest
import torch

from neuma_lib.errors import NonFiniteError
from neuma_lib.project.find import find_laws, find_scene
from neuma_lib.splatting.gaussians import Gaussians
from neuma_lib.viewer.playground import ADDED_PARTICLES, Playground, first_law
from tests.support.errors import refused
from tests.support.viewer_project import LAW, SCENE, make_project

CONSTANTS = f"{SCENE}: Constants"
PRIOR = "prior: jelly"


@pytest.fixture
def project(tmp_path):
    settings, files = find_scene(make_project(tmp_path / "project"))
    return files, find_laws(settings)


@pytest.fixture
def playground(project):
    files, laws = project
    made = Playground(files, laws, first_law(files, laws))
    made.simulation.run(False)
    made.simulation.open()
    yield made
    made.simulation.close()


def test_laws_of_the_results_are_found_with_their_time_steps(project):
    files, laws = project
    assert list(laws) == [CONSTANTS, PRIOR]
    assert {law.dt for law in laws.values()} == {1e-3}
    law = laws[CONSTANTS].load(files.checked).law
    assert law.elasticity.values["E"] == LAW["elasticity"]["E"]
    assert first_law(files, laws, ("constants",)) == CONSTANTS
    with refused(files.name):
        first_law(files, {})


def test_a_prior_has_the_step_of_the_displayed_scene(tmp_path):
    settings, files = find_scene(make_project(tmp_path / "project"))
    other = settings.scenes[SCENE].model_copy(update={"dt": 2e-3})
    settings = settings.model_copy(update={"scenes": {**settings.scenes, "Other": other}})
    assert find_laws(settings)[PRIOR].dt == find_laws(settings, SCENE)[PRIOR].dt == 1e-3
    assert find_laws(settings, "Other+seed=1")[PRIOR].dt == 2e-3


def test_a_law_outside_the_folders_is_not_read(project, playground, tmp_path):
    files, laws = project
    prior = tmp_path / "project" / "results" / "priors" / "jelly.safetensors"
    prior.rename(tmp_path / "jelly.safetensors")
    prior.symlink_to(tmp_path / "jelly.safetensors")
    with refused("jelly.safetensors"):
        Playground(files, laws, PRIOR)
    before = playground.chosen
    with refused("jelly.safetensors"):
        playground._loaded.clear() or playground.choose(PRIOR)
    assert playground.chosen == before and playground.simulation.do().trouble is None


def test_a_law_takes_its_first_step_in_the_thread_that_loads_it(project, monkeypatch):
    files, laws = project
    steps = []

    def step(model, law, state, **options):
        steps.append((threading.current_thread(), law.name, model.dt, options["steps"]))
        raise NonFiniteError("step", "it diverges")

    monkeypatch.setattr("neuma_lib.viewer.playground.rollout", step)
    playground = Playground(files, laws, CONSTANTS)
    assert [playground.law(name) for name in (PRIOR, PRIOR)] == [playground.law(PRIOR)] * 2
    here = threading.current_thread()
    assert steps == [(here, playground.law(name).name, 1e-3, 1) for name in (CONSTANTS, PRIOR)]


def test_gaussians_follow_the_simulation(playground):
    snapshot = playground.simulation.do()
    picture = playground.picture(snapshot)
    assert isinstance(picture.gaussians, Gaussians)
    assert torch.allclose(picture.means, picture.gaussians.means, atol=1e-6)
    assert torch.allclose(picture.covars, picture.gaussians.covars(), atol=1e-9)
    playground.simulation.drop(0.3)
    raised = playground.simulation.do()
    shift = raised.x[0] - snapshot.x[0]
    assert torch.allclose(playground.picture(raised).means, picture.means + shift, atol=1e-5)
    for name in ("speed", "von_mises", "plastic_strain", "volume_ratio"):
        values = playground.values(raised, name)
        assert values.shape == (400,) and values.isfinite().all()


def test_an_added_letter_is_removed_by_a_reset(playground):
    playground.simulation.drop(0.0)
    assert playground.add("letter_N") is None
    snapshot = playground.simulation.do()
    first, letter = snapshot.x.split(list(snapshot.counts))
    assert len(letter) == pytest.approx(ADDED_PARTICLES, rel=0.1) and letter[:, 1].min() > first[:, 1].max()
    picture = playground.picture(snapshot)
    assert torch.allclose(picture.means[-len(letter) :], letter, atol=1e-6), "a Gaussian on each particle"
    while (notice := playground.add("ball")) is None:
        pass
    assert "no room" in notice
    counts = playground.simulation.do().counts
    assert len(playground.picture(playground.simulation.snapshot).means) == 64 + sum(counts[1:])
    playground.reset()
    assert playground.simulation.do().counts == (400,)
    assert len(playground.picture(playground.simulation.snapshot).means) == 64
    with refused("shape"):
        playground.add("teapot")
