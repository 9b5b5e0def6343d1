"""Uncertainty of a motion that is predicted with identified constants."""

import numpy as np
import pytest
import torch

from neuma_lib.evaluation import motion_spread
from neuma_lib.evaluation.constants_draws import constants_draws, stable_law
from neuma_lib.evaluation.motion_spread import SHAPES, Launch, Resolution, other_motions, predict_with_spread
from neuma_lib.fitting.families import FRICTION, MAX_COURANT, Family
from neuma_lib.geometry import shapes
from neuma_lib.geometry.shapes import place
from neuma_lib.mechanics.analytic import analytic_law
from neuma_lib.mechanics.catalogue import COURANT_LIMIT
from neuma_lib.sim.model import MPM
from tests.support.errors import refused

MODEL = MPM(14, 2e-3)
FINE, COARSE = Resolution(MODEL, 260), Resolution(MODEL, 120)
TIMES = [2e-3 * n for n in (10, 20, 30, 40)]
LAW = {"elasticity": {"name": "hencky", "E": 2e4, "nu": 0.3}}
FAMILY = Family("hencky", LAW)


@pytest.fixture(scope="module")
def launch():
    return Launch(place("ball", 0.26, 0.2, (0.5, 0.5), resolution=24), (0.5, -2.0, 0.0))


def identified(variances=(0.0, 0.0), laplace=(0.0, 0.0), spec=LAW, **changes):
    unbounded = FAMILY.unbounded_dict(FAMILY.guess, np.diag(variances))
    unbounded["laplace"] = np.diag(laplace).tolist()
    return {"best": {"law": spec, "unbounded": unbounded, "quantities": {}}, "ties": [], **changes}


def predicted(launch, content, resolutions=(FINE, FINE), model_std=0.0, seed=0):
    return predict_with_spread(content, "best", launch, resolutions, TIMES, 20, model_std, seed)


def test_a_sure_motion_has_the_error_of_the_simulation_alone(launch):
    """Of equal resolutions that of another sampling. Positions are those of the law's simulation."""
    motion = predicted(launch, identified(), (COARSE, FINE))
    assert 0 < motion.first < 4 and motion.failed == 0
    assert motion.value.shape == (4 - motion.first, 20, 3) == motion.std.shape
    steps = [round(t / MODEL.dt) for t in TIMES]
    law = analytic_law(LAW, MODEL.dt)
    path = FINE.path(launch, law, steps, motion.points, seed=0)[motion.first :]
    np.testing.assert_allclose(motion.value, path, atol=1e-5)
    other = COARSE.path(launch, law, steps, motion.points, seed=1)[motion.first :]
    per_axis = ((path - other).square().sum(-1, keepdim=True) / 3).sqrt().expand(-1, -1, 3)
    np.testing.assert_allclose(motion.std, per_axis, atol=1e-5)
    assert motion.laplace_std.abs().max() < 1e-5


def test_the_spread_is_that_of_the_constants(launch, monkeypatch):
    """For a small error of E, to first order: |dx / d log E| std, where the motion depends on E."""
    monkeypatch.setattr(motion_spread, "DRAWS", 150)
    std = 0.05
    motion = predicted(launch, identified((std**2, 0.0), (0.25 * std**2, 0.0)))
    steps = [round(t / MODEL.dt) for t in TIMES]
    up, down = (
        FINE.path(
            launch,
            analytic_law({"elasticity": {**LAW["elasticity"], "E": 2e4 * np.exp(h)}}, MODEL.dt),
            steps,
            motion.points,
            seed=0,
        )[motion.first :]
        for h in (std, -std)
    )
    expected = ((up - down) / 2).abs().double()
    other = FINE.path(launch, analytic_law(LAW, MODEL.dt), steps, motion.points, seed=1)[motion.first :]
    remainder = (motion.value - other).square().sum(-1, keepdim=True) / 3
    spread = (motion.std.square() - remainder).clamp(min=0).sqrt().double()
    clear = expected > 0.3 * expected.max()
    # A quantile of 150 samples has a relative error of about 0.1, that of a half width a little less.
    assert clear.sum() > 10 and ((spread / expected)[clear] - 1).abs().median() < 0.15
    assert ((motion.laplace_std.double() / expected)[clear] - 0.5).abs().median() < 0.08


def test_other_motions_start_inside_and_touch_the_floor():
    scene = {
        "shape": "bottle", "size": 0.36, "height": 0.5, "center": [0.4, 0.6], "density": 900.0,
        "velocity": [0.5, -1.0, -0.3], "spin": [1.0, 2.0, -3.0],
    }  # fmt: skip
    motions = other_motions(scene)
    assert set(SHAPES) == set(shapes.NAMES)
    again, other = motions["launch"], motions["shape"]
    assert tuple(again.velocity) == (-0.5, -3.0, 0.3) and list(again.spin) == [-1.0, -2.0, 3.0]
    assert other.mesh.extents.max() == pytest.approx(0.36, rel=0.02)
    assert abs(other.mesh.volume / again.mesh.volume - 1) > 0.05
    for launch in motions.values():
        assert launch.density == 900.0 and (launch.mesh.bounds > 0).all() and (launch.mesh.bounds < 1).all()


def test_fitted_friction_is_used_and_sampled(launch):
    """A launch along the floor is slower with friction, and less sure where the coefficient is."""
    sliding = Launch(launch.mesh, (2.0, -1.5, 0.0))
    record = {"value": 5.0, "log_std": 0.3}  # of another grid

    def content(log_std):
        known = identified(**{FRICTION: record})
        quantity = {"value": 0.3, "log_std": log_std, "laplace_log_std": 0.0}
        known["best"]["quantities"] = {FRICTION: quantity}
        return known

    free = predicted(sliding, identified(), (FINE, Resolution(MODEL.with_friction(0.0), 260)))
    rough, unsure = predicted(sliding, content(0.0)), predicted(sliding, content(0.5))
    assert rough.value[-1, :, 0].mean() < free.value[-1, :, 0].mean() - 1e-3
    known = predicted(sliding, identified(), (FINE, Resolution(MODEL.with_friction(0.3), 260)))
    np.testing.assert_allclose(rough.value, known.value, atol=1e-6)
    assert unsure.std[-1, :, 0].mean() > rough.std[-1, :, 0].mean() + 1e-3
    assert unsure.laplace_std.abs().max() < 1e-5
    sticks = predicted(sliding, identified(**{FRICTION: {"at_least": 1.0}}))
    given = predicted(sliding, identified(), (FINE, Resolution(MODEL.with_friction(float("inf")), 260)))
    np.testing.assert_allclose(sticks.value, given.value, atol=1e-6)


def test_a_body_that_touches_nothing_is_refused(launch):
    with refused("times"):
        predict_with_spread(
            identified(), "best", Launch(launch.mesh, (0, 1.0, 0)), (FINE, FINE), TIMES[:2], 5, 0.0, 0
        )


def test_stiff_samples_are_stable():
    """Laws that are sampled or extrapolated beyond the stiffness that the time step allows are limited to it."""
    hard = identified((4.0, 0.0), spec=LAW)
    laws = constants_draws(hard, 0.0, MODEL.dt, 60, 0, stable_in=(MODEL, 1000.0))
    courant = [MODEL.courant(law, 1000.0) for law in laws]
    assert max(courant) == pytest.approx(MAX_COURANT, rel=1e-3)
    free = constants_draws(hard, 0.0, MODEL.dt, 60, 0)
    assert max(MODEL.courant(law, 1000.0) for law in free) > COURANT_LIMIT
    soft = [law for law, each in zip(free, courant, strict=True) if each < 0.9 * MAX_COURANT]
    assert {float(law.elasticity.values["E"]) for law in soft} <= {
        float(law.elasticity.values["E"]) for law in laws
    }
    stiff = FAMILY.unbounded_dict({"E": 1e9, "nu": 0.3}, np.zeros((2, 2)))
    law = stable_law({"law": LAW, "unbounded": stiff}, MODEL, 1000.0)
    assert MODEL.courant(law, 1000.0) == pytest.approx(MAX_COURANT, rel=1e-3)


def test_the_laplace_samples_are_of_the_selected_family_without_errors_of_the_images(launch):
    other = {"elasticity": {"name": "neo_hookean", "E": 4e4, "nu": 0.3}}
    content = identified(ties=["other"])
    content["families"] = {"other": {**identified(spec=other)["best"]}}
    motion = predicted(launch, content, model_std=0.1)
    assert motion.laplace_std.abs().max() < 1e-5 < motion.std.max()
    assert torch.isfinite(motion.std).all()
