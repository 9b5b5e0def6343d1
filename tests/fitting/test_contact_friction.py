"""The Coulomb coefficient of a body and its obstacles, a constant that `identify` fits to videos with a known one."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from neuma_lib.config.identify import IdentifyConfig
from neuma_lib.config.laws import LawConfig
from neuma_lib.coupling.initial_motion import InitialMotion
from neuma_lib.fitting.families import FRICTION, Family
from neuma_lib.fitting.identified import recorded_friction
from neuma_lib.fitting.identify import identify
from neuma_lib.io.files import write_json
from neuma_lib.mechanics.analytic import analytic_law
from neuma_lib.sim.model import MPM
from neuma_lib.sim.rollout import rollout
from neuma_lib.splatting.observation import Observation
from tests.support.errors import refused
from tests.support.grounding_scene import block, observe
from tests.support.sim_scenes import law_spec as law

pytestmark = pytest.mark.core

ROUGH = MPM(grid=16, dt=2e-3, contact="particles")
V0 = (1.0, -0.7, 0.0)
FRAMES = tuple(range(0, 121, 8))
TRUTH = {"E": 6e4, "nu": 0.3}
NOISE = 0.01  # standard deviation of a colour
SETTINGS = IdentifyConfig(
    families={"hencky": LawConfig(**law("hencky", E=2e5))},
    pyramid=(4, 8, 32),
    pose_tolerance=0.0,
    covariance_from="elastic",
    refined_particles=0,
    contact_friction="fitted",
)


def images(friction, **constants):
    """Images of the sliding block without noise."""
    spec = law("hencky", **{**TRUTH, **constants})
    return observe(block(), V0, FRAMES, spec, model=ROUGH.with_friction(friction))


def identified_at(friction, model=ROUGH, **options):
    """What is identified in a noisy video of the block on a floor with a Coulomb coefficient."""
    body, seen = block(), images(friction)
    noise = torch.randn(
        seen.images.shape, generator=torch.Generator().manual_seed(5), dtype=seen.images.dtype
    )
    video = Observation(seen.frames, seen.images + NOISE * noise, seen.cameras)
    centre = (body.mass @ body.x0 / body.mass.sum()).numpy()
    motion = InitialMotion(np.array(V0), np.zeros(3), centre, np.eye(3), np.zeros(6))
    return identify(model, motion, body, video, SETTINGS.model_copy(update=options))


def smallest_std(friction):
    """Standard deviation of log(friction) that the noise of the pixels leaves: no estimate can have a smaller one.

    sigma^2 (J^T J)^-1 with the derivatives of the images by the logarithms of all constants (Cramer-Rao).
    """
    h, truth = 0.01, {**TRUTH, "friction": friction}
    base = images(**truth).images
    changes = [images(**{**truth, key: value * math.exp(h)}).images - base for key, value in truth.items()]
    J = torch.stack([change.flatten() / h for change in changes], dim=1)
    return NOISE * float(torch.linalg.inv(J.T @ J)[-1, -1]) ** 0.5


@pytest.mark.parametrize("given", ["no_slip", {"y_min": 0.9}])
def test_the_coefficient_of_a_sliding_body_is_identified(given, tmp_path):
    """Within two of its stated standard deviations, which are no smaller than the noise permits, and within four of
    those that the noise leaves. What the scene gives has no effect. Files have it next to the law."""
    result = identified_at(0.3, replace(ROUGH, boundary=given))
    content = result.as_dict()
    value, std = (content[FRICTION][key] for key in ("value", "log_std"))
    from_images = content["best"]["constants"][FRICTION]["log_std"]
    smallest = smallest_std(0.3)
    assert abs(math.log(value / 0.3)) < min(2 * from_images, 4 * smallest) and smallest < from_images < 0.1
    assert std == pytest.approx(math.hypot(from_images, SETTINGS.model_std))
    assert result.best.values["E"] == pytest.approx(6e4, rel=0.02)
    assert (
        content["best"]["quantities"][FRICTION]["determined"]
        and f"{FRICTION} = {value:.4g}" in content["says"]
    )
    assert all(set(axis["powers"]) == {"G", "K", FRICTION} for axis in content["best"]["combinations"])
    assert FRICTION not in str(content["law"]) + str(content["best"]["unbounded"])
    write_json(tmp_path / "identified.json", content)  # refuses what is no number
    assert recorded_friction(content) == value


@pytest.mark.parametrize("friction", [3.0, math.inf])
def test_a_body_that_sticks_gives_a_lower_bound(friction, tmp_path):
    """It is below the truth, and above the ratio of the impulses of friction and of the floor over the video, since no
    smaller coefficient could have stopped the block. The ratio follows from the velocities of its centre."""
    result = identified_at(friction)
    content = result.as_dict()
    lowest = content[FRICTION]["at_least"]
    path = rollout(
        ROUGH.with_friction(friction),
        analytic_law(law("hencky", **TRUTH)),
        block().state(V0),
        steps=120,
        frames=(120,),
    )
    change = path.v[0].mean(dim=0) - torch.tensor(V0) - 120 * ROUGH.dt * torch.tensor(ROUGH.gravity)
    assert list(content[FRICTION]) == ["at_least"] and -float(change[0] / change[1]) < lowest < friction
    assert set(result.best.values) == {"E", "nu"} and FRICTION not in content["best"]["quantities"]
    from_images = content["best"]["constants"]["E"]["log_std"]
    assert abs(math.log(result.best.values["E"] / 6e4)) < 3 * from_images and from_images < 0.05
    assert (
        recorded_friction(content) == math.inf
        and f"{FRICTION} >= {lowest:.2g} (it may stick)" in content["says"]
    )
    write_json(tmp_path / "identified.json", content)
    pytest.importorskip("matplotlib")
    from neuma_lib.paper.identified_page import identified_page

    assert "at least" in identified_page(content, law("hencky", **TRUTH)).axes[1].get_title()


def test_a_given_coefficient_is_no_constant():
    """That of the model is used: with the true one, the constants are identified."""
    result = identified_at(0.3, ROUGH.with_friction(0.3), contact_friction="given")
    assert FRICTION not in result.as_dict() and result.best.family.constants == ("E", "nu")
    assert result.best.values["E"] == pytest.approx(6e4, rel=0.02)
    assert recorded_friction(result.as_dict()) is None


def test_friction_of_nodes_is_refused():
    with refused("identify.contact_friction"):
        identified_at(0.3, replace(ROUGH, contact="nodes"))


def test_the_coefficient_belongs_to_no_law_and_limits_no_flow():
    spec = law("hencky", "von_mises", yield_stress=4e3)
    family, plain = Family("x", spec, contact_friction=True), Family("x", spec)
    assert family.constants == (*plain.constants, FRICTION)
    values = {**plain.guess, FRICTION: 0.2}
    assert family.law_spec(values) == plain.law_spec(plain.guess)
    assert family.bounded(family.unbounded(values)) == pytest.approx(values)
    (weaker,) = family.with_other_limits(values, (1,))
    assert weaker[FRICTION] == pytest.approx(0.2) and weaker["yield_stress"] == pytest.approx(1.6e4)
    elastic = Family("x", law("hencky"), contact_friction=True)
    assert not elastic.flows and family.contains(elastic)
