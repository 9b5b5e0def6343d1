"""Constants of a family, their bounds, uncertainty and extrapolation, without a video."""

import math
from dataclasses import replace

import numpy as np
import pytest

from neuma_lib.fitting.families import MAX_COURANT, Family
from neuma_lib.fitting.identified import FamilyFit, Identified
from neuma_lib.mechanics.analytic import analytic_law
from neuma_lib.mechanics.catalogue import COURANT_LIMIT
from neuma_lib.mechanics.combinations import physical
from tests.support.grounding_scene import MODEL
from tests.support.identification import ELASTIC, FLUID, PLASTIC, ball, known, settings
from tests.support.sim_scenes import law_spec as law

pytestmark = pytest.mark.core

DENSITY = 1000.0


@pytest.mark.parametrize("refinement", [1.5, 2])
def test_an_extrapolation_covers_both_orders_of_convergence(refinement):
    """Errors of log E that are proportional to dx^2 vanish, those that are proportional to dx are one standard
    deviation."""
    family = Family("hencky", ELASTIC)

    def fit(log_error, covariance=None):
        return FamilyFit(family, {"E": 1e5 * math.exp(log_error), "nu": 0.3}, covariance=covariance)

    for order, deviations in ((1, 1.0), (2, 0.0)):
        fine = fit(0.1 / refinement**order, 1e-6 * np.eye(2)).extrapolated(fit(0.1), refinement, 4)
        error, std = math.log(fine.values["E"] / 1e5), math.sqrt(fine.covariance[0, 0] - 1e-6)
        assert abs(error) == pytest.approx(deviations * std, rel=1e-6, abs=1e-9) and std > 1e-3
        assert fine.values["nu"] == pytest.approx(0.3) and fine.covariance[1, 1] == pytest.approx(1e-6)
    vague = np.array([[0.5, 1e-5], [1e-5, 1e-8]])
    joined = fit(0.0, 1e-6 * np.eye(2)).extrapolated(fit(0.0, vague), refinement, 4).covariance
    assert all(np.linalg.eigvalsh(joined - each).min() > -1e-12 for each in (vague, 1e-6 * np.eye(2)))
    assert np.trace(joined) < np.trace(vague) + 3e-6, "the larger of both, not their sum"
    far = fit(-math.log(9), 1e-6 * np.eye(2)).extrapolated(fit(0.0), refinement, 4)
    limited = -math.log(9) - math.log(2) / (refinement**2 - 1)
    assert math.log(far.values["E"] / 1e5) == pytest.approx(limited)
    assert far.covariance[0, 0] > 0.5 * (math.log(9) / refinement) ** 2


def test_more_particles_on_the_same_grid_are_not_extrapolated():
    """The remaining error, if it is proportional to the inverse of the number, is one standard deviation."""
    family = Family("hencky", ELASTIC)

    def fit(count):
        values = {"E": 1e5 * math.exp(0.4 * 1000 / count), "nu": 0.3}
        return FamilyFit(family, values, covariance=1e-6 * np.eye(2))

    material = fit(4000).extrapolated(fit(1000), 1.0, 4)
    assert material.values == pytest.approx(fit(4000).values)
    assert math.sqrt(material.covariance[0, 0] - 1e-6) == pytest.approx(0.1)


def test_a_constant_at_its_bound_leaves_uncertain_what_depends_on_it():
    """Poisson's ratio next to 0, where its logit is uncertain by 5, may be up to 0.11: the moduli from draws."""
    family, std = Family("hencky", ELASTIC), 5.0
    fit = FamilyFit(family, {"E": 1e5, "nu": 0.001}, covariance=np.diag([1e-6, std**2]))
    names, covariance = fit.log_covariance(physical)
    u = family.unbounded(fit.values)
    draws = [family.bounded(u + [0, std * z]) for z in np.random.default_rng(0).standard_normal(20_000)]
    for name, variance in zip(names, np.diag(covariance), strict=True):
        low, high = np.quantile([math.log(physical(values)[name]) for values in draws], [0.159, 0.841])
        assert math.sqrt(variance) > 0.04 and math.sqrt(variance) == pytest.approx((high - low) / 2, rel=0.1)
    sure = FamilyFit(family, {"E": 1e5, "nu": 0.3}, covariance=1e-6 * np.eye(2))
    E, G, K = (
        sure.log_covariance(lambda v, key=key: {key: {**v, **physical(v)}[key]})[1][0, 0] for key in "EGK"
    )
    slope = 0.3 * (1 - 0.3 / 0.5)  # of nu by its logit
    assert E == pytest.approx(1e-6) and G == pytest.approx(1e-6 * (1 + (slope / 1.3) ** 2), rel=1e-4)
    assert K == pytest.approx(1e-6 * (1 + (2 * slope / 0.4) ** 2), rel=1e-4)


def test_what_parts_of_the_video_and_tied_families_disagree_about_is_uncertain():
    """The change since the fit to the first frames, and the scatter of shared constants over families that are as good,
    are uncertain; what is not shared is not."""
    family, other = Family("plastic", PLASTIC), Family("elastic", law("neo_hookean"))
    values = {"E": 6e4, "nu": 0.3, "yield_stress": 4e3}
    first = FamilyFit(family, {**values, "E": 5e4})
    fit = FamilyFit(family, values)
    alone = fit.disagreement(first, [])
    np.testing.assert_allclose(np.sqrt(np.diag(alone)), [math.log(6 / 5), 0, 0], atol=1e-12)
    tied = alone + fit.disagreement(fit, [FamilyFit(other, {"E": 12e4, "nu": 0.3})])
    expected = [math.hypot(math.log(6 / 5), math.log(2) / math.sqrt(2)), 0, 0]
    np.testing.assert_allclose(np.sqrt(np.diag(tied)), expected, atol=1e-12)


def test_nesting_of_families():
    bingham = Family("bingham", law("hencky", "viscous_flow", viscosity=50, yield_stress=1e3))
    elastic, plastic, fluid = (Family("x", spec) for spec in (ELASTIC, PLASTIC, FLUID))
    grains = Family("x", law("hencky", "drucker_prager", friction_angle=30))
    assert bingham.contains(plastic) and bingham.contains(fluid) and bingham.contains(elastic)
    assert plastic.contains(elastic) and not plastic.contains(fluid) and not plastic.contains(plastic)
    assert not grains.contains(elastic), "sand bears no tension, whatever its friction"
    assert not plastic.contains(Family("x", law("neo_hookean")))


def test_unbounded_constants_return_and_stay_within_bounds_and_the_time_step():
    family = Family("grains", law("hencky", "drucker_prager", E=3e4, nu=0.2, friction_angle=40))
    values = {"E": 3e4, "nu": 0.2, "friction_angle": 40.0}
    assert family.bounded(family.unbounded(values)) == pytest.approx(values, rel=1e-12)
    for far in (-100.0, 100.0):
        values = family.values(np.array([abs(far), far, far]), MODEL, DENSITY)
        assert 0 < values["nu"] < 0.5 and 0 < values["friction_angle"] < 90
        number = MODEL.check_courant(analytic_law(family.law_spec(values)), DENSITY)
        assert number == pytest.approx(MAX_COURANT, rel=1e-3) or values["E"] < 1e-3
        assert MAX_COURANT < 0.9 * COURANT_LIMIT, "a correction may stiffen the law by a fifth"


def test_constants_between_any_bounds_are_unbounded_and_return():
    """Also those whose lower bound is not 0: exponents from 0.2, angles from -180 degrees."""
    flow = {"name": "herschel_bulkley", "consistency": 8.0, "exponent": 2.0, "yield_stress": 30.0}
    fibres = {"name": "fibre_reinforced", "E": 3e4, "nu": 0.2, "fibre_modulus": 1e5, "fibre_exponent": 2.0}
    paste = Family("paste", {"elasticity": {"name": "hencky", "E": 3e4, "nu": 0.2}, "plasticity": flow})
    tendon = Family("tendon", {"elasticity": {**fibres, "azimuth": -120.0, "elevation": 25.0}})
    for family, low, high in (
        (paste, {"exponent": 0.2}, {"exponent": 3.0}),
        (tendon, {"azimuth": -180.0}, {}),
    ):
        u = family.unbounded(family.guess)
        assert family.bounded(u) == pytest.approx(family.guess, rel=1e-12)
        for bounds, far in ((low, -100.0), (high, 100.0)):
            values = family.bounded(np.where([key in bounds for key in family.constants], far, u))
            assert {key: values[key] for key in bounds} == pytest.approx(bounds, rel=1e-4)


def test_less_flow_is_towards_the_elastic_limit_and_within_bounds():
    values = {"E": 3e4, "nu": 0.2}
    family = Family("plastic", law("hencky", "von_mises", yield_stress=4e3))
    result = family.with_other_limits({**values, "yield_stress": 1e3}, (1, 2))
    assert [v["yield_stress"] for v in result] == pytest.approx([4e3, 1.6e4])
    assert all(v["E"] == pytest.approx(3e4) and v["nu"] == pytest.approx(0.2) for v in result)
    grains = Family("grains", law("hencky", "drucker_prager", friction_angle=30))
    angles = [
        v["friction_angle"] for v in grains.with_other_limits({**values, "friction_angle": 30.0}, (1, 2))
    ]
    assert 30 < angles[0] < angles[1] < 90
    assert Family("elastic", ELASTIC).with_other_limits(values, (1, 2)) == []


def test_a_published_law_gives_what_the_family_has():
    family = Family("plastic", PLASTIC)
    known = {"E": 1e5, "nu": -0.2, "friction_angle": 25.0}
    assert family.with_guesses(known) == {"E": 1e5, "nu": 0.3, "yield_stress": 4e3}
    bounds = {"E": 0.0, "nu": 0.0, "yield_stress": 0.0}  # have no logarithm or logit
    assert family.with_guesses(bounds) == family.with_guesses({})


def test_combinations_are_those_of_the_covariance():
    """Of a body whose E is open and nu sure, the ratio of both moduli is determined and their product is not."""
    family = Family("hencky", ELASTIC)
    fit = FamilyFit(family, {"E": 6e4, "nu": 0.3}, covariance=np.diag([0.25, 1e-12]))
    options = settings({"hencky": ELASTIC}, model_std=0.02)
    first, second = fit.combinations(options)
    assert first["determined"] and not second["determined"]
    assert second["powers"]["G"] == pytest.approx(second["powers"]["K"], abs=1e-4)  # log E moves both alike
    assert second["log_std"] == pytest.approx(math.sqrt(2) * 0.5, rel=1e-2)
    (_, E, std), *_ = fit.quantities(options)
    assert E == 6e4 and std == pytest.approx(0.5, rel=1e-2)


def test_errors_that_all_images_share_are_part_of_every_uncertainty():
    """Images without any error leave `model_std`."""
    family, start = Family("hencky", ELASTIC), known(ball())
    fit = FamilyFit(family, {"E": 6e4, "nu": 0.3}, 1.0, covariance=np.zeros((2, 2)), motions=(start,))
    options = settings({"hencky": ELASTIC}, model_std=0.07)
    assert [std for *_, std in fit.quantities(options)] == pytest.approx(
        [0.07] * len(fit.quantities(options))
    )
    assert [each["log_std"] for each in fit.combinations(options)] == pytest.approx([0.07, 0.07])
    stds = [each["log_std"] for each in fit.as_dict(options)["quantities"].values()]
    assert stds == pytest.approx([0.07] * len(stds))


def test_a_summary_lists_what_is_determined_and_what_is_not():
    family = Family("plastic", PLASTIC)
    values = {"E": 6e4, "nu": 0.3, "yield_stress": 4e3}
    fit = FamilyFit(family, values, 1.0, covariance=np.diag([0.25, 1e-8, 1e-8]))
    options = settings({"hencky": ELASTIC})
    text = Identified(fit, ["other"], {}, [], [], 0, 24, options).summary()
    assert text.startswith("plastic (tie with other): E = 6e+04, nu = 0.3, yield_stress = 4000; determined: ")
    determined, rest = text.partition("; determined: ")[2].split("; not determined: ")
    assert "yield_stress" in determined.split(", ") and "E" in rest.split(", ")
    sure = replace(fit, covariance=1e-8 * np.eye(3))
    assert "not determined" not in Identified(sure, [], {}, [], [], 0, 24, options).summary()
