"""Identification of a block whose stiffness changes along it, against candidates that are uniform."""

import numpy as np
import pytest
import torch

from neuma_lib.config.identify import IdentifyConfig
from neuma_lib.config.laws import LawConfig
from neuma_lib.coupling.initial_motion import InitialMotion
from neuma_lib.fitting.families import Family
from neuma_lib.fitting.identify import identify
from neuma_lib.mechanics.analytic import analytic_law
from neuma_lib.sim.rollout import rollout
from neuma_lib.splatting.observation import Observation
from tests.support.grounding_scene import MODEL, block, camera
from tests.support.sim_scenes import law_spec as law

pytestmark = pytest.mark.core

FRAMES = tuple(range(0, 121, 8))
VELOCITY = (0.3, -1.5, 0.0)
GUESS = law("hencky", E=2e5)
FAMILIES = {
    "uniform": GUESS,
    "ramp": {**GUESS, "field": {"name": "ramp", "ratio": 1.0}},
    "halves": {**GUESS, "field": {"name": "halves", "ratio": 1.0, "boundary": 0.5}},
}


def identified(field):
    """The block filmed with noise, identified from a uniform guess."""
    body, truth = block(), law("hencky", E=4e4)
    with torch.no_grad():
        own = analytic_law({**truth, **({"field": field} if field else {})}, MODEL.dt)
        path = rollout(MODEL, own, body.state(VELOCITY), steps=FRAMES[-1], frames=FRAMES, total=True)
        images = body.particle_gs(camera())(path.x, path.F_total)
    noise = torch.randn(images.shape, generator=torch.Generator().manual_seed(5), dtype=images.dtype)
    centre = (body.mass @ body.x0 / body.mass.sum()).numpy()
    motion = InitialMotion(np.array(VELOCITY), np.zeros(3), centre, np.eye(3), np.zeros(6))
    families = {name: LawConfig(**spec) for name, spec in FAMILIES.items()}
    settings = IdentifyConfig(families=families, pyramid=(4, 8, 32), pose_tolerance=0.0)
    video = Observation(FRAMES, images + 0.01 * noise, camera())
    return identify(MODEL, motion, body, video, settings)


@pytest.mark.parametrize("ratio", [3.0, 0.3])
def test_a_ramp(ratio):
    result = identified({"name": "ramp", "ratio": ratio})
    assert result.best.family.name == "ramp" and "uniform" not in result.ties
    assert result.best.values["E"] == pytest.approx(4e4, rel=0.1)
    assert result.best.values["ratio"] == pytest.approx(ratio, rel=0.1)
    assert result.best.family.law_spec(result.best.values)["field"]["name"] == "ramp"


def test_two_halves():
    result = identified({"name": "halves", "ratio": 0.3, "boundary": 0.6})
    assert result.best.family.name == "halves" and "uniform" not in result.ties
    assert result.best.values["E"] == pytest.approx(4e4, rel=0.1)
    assert result.best.values["ratio"] == pytest.approx(0.3, rel=0.1)
    assert result.best.values["boundary"] == pytest.approx(0.6, abs=0.03)


def test_a_uniform_block_is_uniform():
    result = identified(None)
    assert result.best.family.name == "uniform"
    assert result.best.values["E"] == pytest.approx(4e4, rel=0.1)


def test_limits_of_families_with_fields():
    uniform, ramp, halves = (Family(name, spec) for name, spec in FAMILIES.items())
    assert ramp.constants == ("E", "nu", "ratio") and not ramp.flows
    assert ramp.contains(uniform) and halves.contains(uniform)
    assert not halves.contains(ramp) and not uniform.contains(ramp)
    stiff = {"E": 1e12, "nu": 0.3}
    limits = [own.limited({**own.guess, **stiff}, MODEL, 1000.0)["E"] for own in (uniform, ramp)]
    assert limits[0] == limits[1]
    steep = ramp.limited({**stiff, "ratio": 4.0}, MODEL, 1000.0)["E"]
    assert steep == pytest.approx(limits[0] / 4)
