"""Identification of several bodies in one video: a ball that falls on a sliding block."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from neuma_lib.config.identify import IdentifyConfig
from neuma_lib.config.laws import LawConfig
from neuma_lib.coupling.bodies import join
from neuma_lib.coupling.initial_motion import InitialMotion
from neuma_lib.fitting.families import Bodies, Family
from neuma_lib.fitting.identify_bodies import identify_bodies
from neuma_lib.fitting.video_residuals import Candidate, VideoResiduals
from neuma_lib.io.files import write_json
from neuma_lib.mechanics.analytic import analytic_law
from neuma_lib.mechanics.combinations import constants_of, named_combinations
from neuma_lib.sim.bodies import Pair
from neuma_lib.sim.model import consecutive
from neuma_lib.sim.rollout import rollout
from neuma_lib.sim.state import State
from neuma_lib.splatting.observation import Observation
from tests.support.errors import refused
from tests.support.grounding_scene import MODEL, ball, block, camera
from tests.support.sim_scenes import law_spec as law

pytestmark = pytest.mark.core

VELOCITIES = {"block": (0.8, -0.4, 0.0), "ball": (0.0, -1.5, 0.0)}
FRAMES = tuple(range(0, 121, 8))
FRICTION = 0.3
TRUTH = {
    "block": law("hencky", E=1e5, nu=0.3),
    "ball": law("hencky", "von_mises", E=6e4, nu=0.3, yield_stress=2e3),
}
FAMILIES = {"elastic": law("hencky"), "plastic": law("hencky", "von_mises", yield_stress=4e3)}


@pytest.fixture(scope="module")
def filmed():
    """Bodies, their true motions, and a noisy video of them."""
    bodies = [block(), ball(height=0.33)]
    states = [body.state(v) for body, v in zip(bodies, VELOCITIES.values(), strict=True)]
    laws = [analytic_law(spec, MODEL.dt) for spec in TRUTH.values()]
    with torch.no_grad():
        path = rollout(
            replace(MODEL, pairs=(Pair(0, 1, FRICTION),)),
            consecutive(laws, [len(body.x0) for body in bodies]),
            State.joined(states, separate=True),
            steps=FRAMES[-1],
            frames=FRAMES,
            total=True,
        )
        cameras = camera()
        images = join(bodies).particle_gs(cameras)(path.x, path.F_total)
    noise = 0.01 * torch.randn(images.shape, generator=torch.Generator().manual_seed(5), dtype=images.dtype)
    motions = {}
    for (name, v), body in zip(VELOCITIES.items(), bodies, strict=True):
        centre = (body.mass @ body.x0 / body.mass.sum()).numpy()
        motions[name] = InitialMotion(np.array(v), np.zeros(3), centre, np.eye(3), np.zeros(6))
    return bodies, motions, Observation(FRAMES, images + noise, cameras)


def identified(filmed, given=None, **options):
    bodies, motions, video = filmed
    families = {name: LawConfig(**spec) for name, spec in FAMILIES.items()}
    settings = IdentifyConfig(families=families, pyramid=(4, 8, 32), pose_tolerance=0.0, **options)
    return identify_bodies(MODEL, motions, bodies, video, settings, given)


def check_constants(result):
    """The yield stress of the ball, the friction, and all determined quantities."""
    assert result.bodies["ball"].best.values["yield_stress"] == pytest.approx(2e3, rel=0.05)
    ((friction, log_std),) = result.pairs.values()
    assert friction == pytest.approx(FRICTION, abs=0.05) and abs(np.log(friction / FRICTION)) < 3 * log_std
    for name, each in result.bodies.items():
        truth, determined = named_combinations(constants_of(TRUTH[name])), 0
        for key, value, std in each.best.quantities(each.settings):
            if std < each.settings.determined:
                assert value == pytest.approx(truth[key], rel=0.15), (name, key)
                determined += 1
        assert determined >= 2


def test_constants_and_friction_of_the_truth(filmed, tmp_path):
    """From guesses two to three times too stiff, with friction of 0.5."""
    result = identified(filmed, {"block": "elastic", "ball": "plastic"})
    check_constants(result)
    assert result.bodies["block"].best.values["E"] == pytest.approx(1e5, rel=0.05)
    assert result.bodies["ball"].best.values["E"] == pytest.approx(6e4, rel=0.1)
    content = result.as_dict()
    write_json(tmp_path / "identified.json", content)  # refuses what is no number
    assert [each["name"] for each in content["start"]["bodies"]] == ["block", "ball"]
    assert content["bodies"]["ball"]["best"]["quantities"]["yield_stress"]["determined"]


def test_families_are_selected_body_by_body(filmed):
    result = identified(filmed)
    assert {name: each.best.family.name for name, each in result.bodies.items()} == {
        "block": "elastic",
        "ball": "plastic",
    }
    check_constants(result)


def test_a_wrong_motion_is_corrected(filmed):
    """An estimated motion that is wrong by a standard deviation. Without the correction friction is 1.2."""
    bodies, motions, video = filmed
    std, error = np.array([0.05] * 3 + [0.0] * 3), np.array([0.05, 0.05, 0.0])
    ball = replace(motions["ball"], velocity=motions["ball"].velocity + error, std=std)
    result = identified((bodies, {**motions, "ball": ball}, video), {"block": "elastic", "ball": "plastic"})
    check_constants(result)
    fitted = result.bodies["ball"].best.motions[0]
    assert np.abs(fitted.velocity - motions["ball"].velocity)[:2].max() < 0.015
    assert fitted.std[:2].max() < 0.02


def test_hidden_share_is_that_of_a_body_behind_another():
    """Light through the nearer body, (1 - its coverage), shows the other. Nothing hides the nearer one.

    A pixel ends at a transmittance of 1e-4.
    """
    bodies = []
    for x, z in ((0.45, 0.3), (0.5, 0.75)):  # the camera is at z = 2
        body = ball(height=0.4)
        shift = torch.tensor([x - 0.5, 0.0, z - 0.5], dtype=torch.float64)
        moved = replace(body.gaussians, means=body.gaussians.means + shift)
        bodies.append(replace(body, x0=body.x0 + shift, gaussians=moved))
    motions = []
    for body in bodies:
        centre = (body.mass @ body.x0 / body.mass.sum()).numpy()
        motions.append(InitialMotion(np.zeros(3), np.zeros(3), centre, np.eye(3), np.zeros(6)))
    cameras, still = camera(), torch.eye(3, dtype=torch.float64).repeat(1, len(bodies[0].x0), 1, 1)
    video = Observation((0, 8), torch.ones(2, 1, 32, 32, 3, dtype=torch.float64), cameras)
    residuals = VideoResiduals(MODEL, motions, bodies, video, IdentifyConfig(pyramid=(4, 32)))
    shares = residuals.hidden_shares(Candidate([TRUTH["block"]] * 2, np.zeros(18)))
    behind, before = (body.particle_gs(cameras).coverage(body.x0[None], still) for body in bodies)
    expected = 1 - (behind * (1 - before)).sum() / behind.sum()
    assert expected > 0.3
    torch.testing.assert_close(
        shares[0], torch.stack([expected, torch.zeros_like(expected)]), atol=2e-4, rtol=0
    )
    assert shares.shape == (2, 2) and shares[1, 0] > 0.3 and shares[1, 1] < 1e-6


def test_constants_of_bodies_are_those_of_their_families():
    """Known constants are not estimated; E is limited as for one body."""
    families = {name: Family(name, spec) for name, spec in zip(TRUTH, FAMILIES.values(), strict=True)}
    bodies = Bodies(families, [(0, 1)])
    assert bodies.constants == (
        "block.E",
        "block.nu",
        "ball.E",
        "ball.nu",
        "ball.yield_stress",
        "block-ball.friction",
    )
    values = bodies.bounded(bodies.unbounded(bodies.guess))
    assert values == pytest.approx(bodies.guess) and bodies.pair_frictions(values) == pytest.approx([0.5])
    stiff = bodies.values(bodies.unbounded({**values, "ball.E": 1e12}), MODEL, 1000.0)
    alone = families["ball"].values(
        families["ball"].unbounded({**families["ball"].guess, "E": 1e12}), MODEL, 1000.0
    )
    assert bodies.of_body(1, stiff) == pytest.approx(alone)
    others = {key: value for key, value in values.items() if not key.startswith("ball.")}
    part = Bodies(families, [(0, 1)], others)
    assert part.constants == bodies.constants[2:5] and part.own(1) == [0, 1, 2] and part.own(0) == []
    assert part.bounded(part.unbounded(values)) == pytest.approx(values)


def test_what_is_refused(filmed):
    with refused("identify.contact_friction"):
        identified(filmed, contact_friction="fitted")
    bodies, motions, video = filmed
    with refused("bodies"):
        identified((bodies[:1], {"block": motions["block"]}, video))
