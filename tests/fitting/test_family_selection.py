"""Starts and fits of candidate families, and the choice among them."""

import math
from types import SimpleNamespace

import numpy as np
import pytest

from neuma_lib.errors import NonFiniteError
from neuma_lib.fitting import identify as identification
from neuma_lib.fitting.families import Family
from neuma_lib.fitting.family_run import FamilyRun
from neuma_lib.fitting.identified import FamilyFit
from neuma_lib.fitting.identify import _better_later, _first_fit, _prune, select_family
from neuma_lib.fitting.least_squares import (
    Linearisation,
)
from neuma_lib.fitting.video_residuals import VideoResiduals
from tests.support.grounding_scene import MODEL
from tests.support.identification import ELASTIC, FLUID, FRAMES, PLASTIC, V0, known, settings, video_of
from tests.support.sim_scenes import law_spec as law

pytestmark = pytest.mark.core


class FakeRun:
    """The attributes of a fit that `_prune` reads: squared residuals, family, and an image."""

    alive = True

    def __init__(self, cost, spec, picture):
        self.fit = Linearisation(np.zeros(0), np.zeros(0), cost, 0.0)
        self.family, self.picture = Family("x", spec), picture

    def resembles(self, other):
        return self.picture == other.picture


def test_families_with_a_high_cost_and_redundant_ones_are_pruned():
    """Families that are merely no better in blurred images are kept, with more constants, of another elasticity, or
    with flow that a contained soft body also reproduces."""
    options = settings({"hencky": ELASTIC}, prune_factor=3.0)
    elastic, far = FakeRun(1.0, ELASTIC, "soft"), FakeRun(3.1, law("neo_hookean"), "far")
    never_yields, flat = FakeRun(0.99, PLASTIC, "soft"), FakeRun(1.2, FLUID, "flat")
    sibling = FakeRun(1.0, law("fixed_corotated"), "soft")
    runs = [elastic, far, never_yields, flat, sibling]
    _prune(runs, options, keep_redundant=True)
    assert [run.alive for run in runs] == [True, False, True, True, True]
    _prune(runs, options)
    assert [run.alive for run in runs] == [True, False, False, True, True]
    grains = FakeRun(1.0, law("hencky", "drucker_prager", friction_angle=30), "soft")
    _prune([elastic, grains], options)
    assert grains.alive, "sand does not contain the elastic body"
    clay, stiffer = FakeRun(2.9, PLASTIC, "clay"), FakeRun(8.8, PLASTIC, "stiffer")
    mud = FakeRun(9.1, law("hencky", "viscous_flow", viscosity=50), "mud")
    _prune([elastic, clay, stiffer, mud], options)
    assert elastic.alive and clay.alive and not stiffer.alive, (
        "return maps are compared by the square of the factor"
    )
    assert not mud.alive
    uneven = FakeRun(0.2, {**ELASTIC, "field": {"name": "ramp", "ratio": 1.0}}, "uneven")
    _prune([elastic, sibling, uneven], options)
    assert elastic.alive and not sibling.alive, "the uniform family of a field is kept, no other"


def test_fits_restart_from_better_ones_that_started_later():
    """From the best of all, and the best one with the same constants, since a flow may lead with constants that suit no
    elastic body."""
    stuck, elastic = FakeRun(9.0, ELASTIC, "stuck"), FakeRun(2.0, law("fixed_corotated"), "soft")
    worse, flow = FakeRun(3.0, law("neo_hookean"), "soft"), FakeRun(1.0, PLASTIC, "flows")
    pairs = _better_later([stuck, elastic, worse, flow])
    assert pairs == [(stuck, flow), (stuck, elastic), (elastic, flow), (worse, flow)]
    stuck.alive = flow.alive = False
    assert _better_later([stuck, elastic, worse, flow]) == []


def test_a_fit_restarts_from_the_best_constants_if_they_are_better():
    """A flow that starts beyond its yield stress never yields: a local minimum that other limits leave."""
    body, seen = video_of(PLASTIC, V0, FRAMES)
    chosen = settings({"plastic": PLASTIC}, covariance_from="elastic", refined_particles=0, iterations=3)
    video, family = VideoResiduals(MODEL, known(body), body, seen, chosen), Family("plastic", PLASTIC)
    stuck = family.with_guesses({"yield_stress": 1e6})
    run = FamilyRun(family, [video], [len(FRAMES)], chosen)
    run.begin([stuck])
    before = run.fit.cost
    run.restart_from([stuck, *family.with_other_limits(stuck, (1, 2))])
    assert run.fit.cost == before, "no start is better"
    run.restart_from([stuck, *family.with_other_limits(stuck, (-4, -2))])
    assert run.fit.cost < 0.5 * before and run.values["yield_stress"] < 1e5


def test_a_flow_that_never_yields_shows_the_elastic_body():
    """And one that yields does not, whatever their squared residuals."""
    body, seen = video_of(ELASTIC, V0, FRAMES)
    chosen = settings({"hencky": ELASTIC}, covariance_from="elastic", refined_particles=0)
    video = VideoResiduals(MODEL, known(body), body, seen, chosen)
    runs = [
        FamilyRun(Family("x", spec), [video], [len(FRAMES)], chosen) for spec in (ELASTIC, PLASTIC, PLASTIC)
    ]
    for run, limit in zip(runs, (1.0, 1e5, 1e3), strict=True):
        values = run.family.with_guesses({"yield_stress": limit})
        run._origin = run.family.unbounded(values)
        run.fit = Linearisation(np.zeros(0), np.zeros(0), run.cost(run._u), 0.0)
    elastic, never_yields, yields = runs
    assert never_yields.resembles(elastic) and not yields.resembles(elastic)


@pytest.mark.parametrize("flat", [1.0, 4.0, math.inf])
def test_a_plateau_widens_what_is_not_determined(flat):
    """Squared residuals that rise so many times less on one side than their quadratic: so much larger is the variance,
    up to that of the spread. A determined axis costs no simulation."""
    chosen, curvature = settings({"hencky": ELASTIC}, spread=2.0, determined=0.1), np.diag([1e4, 5.0])
    run = FamilyRun(Family("hencky", ELASTIC), [SimpleNamespace(deviations=9)], [0], chosen)
    run.fit, tried = Linearisation(np.pad(curvature, (0, 9))[None], np.zeros((1, 11)), 1.0, 1.0), []
    run._covariance = lambda: np.diag([1e-4, 0.25] + [0.0] * 9)

    def cost(u):
        tried.append(u)
        return 1.0 + u @ run.fit.curvature @ u / (flat if u[1] > 0 else 1.0)

    run._simulate, run._cost = lambda points: points, cost
    added = run.covariance_of_plateaus()
    np.testing.assert_allclose(added, np.diag([0.0, min(0.25 * flat, 4.0) - 0.25]), atol=1e-9)
    assert len(tried) == 2 and all(abs(u[1]) == pytest.approx(1.0) for u in tried)


@pytest.mark.parametrize("level", [False, True])
def test_a_fit_that_ends_before_the_minimum_of_a_quadratic_is_on_no_plateau(level):
    """It is 0.8 of the step away, where the cost on one side is hardly higher. Above the slope it is the quadratic."""
    chosen = settings({"hencky": ELASTIC}, spread=2.0, determined=0.1, level_plateaus=level)
    run = FamilyRun(Family("hencky", ELASTIC), [SimpleNamespace(deviations=9)], [0], chosen)
    H, away = np.pad(np.diag([1e4, 5.0]), (0, 9)), np.eye(11)[1] * 0.4
    run.fit = Linearisation(H[None], np.zeros((1, 11)), away @ H @ away, 1.0)
    run._covariance = lambda: np.diag([1e-4, 0.25] + [0.0] * 9)
    run._simulate, run._cost = lambda points: points, lambda u: (u - away) @ H @ (u - away)
    added = run.covariance_of_plateaus()
    # The step is 1: (1 - 0.4)^2 - 0.4^2 = 0.2 of the quadratic.
    np.testing.assert_allclose(added, np.diag([0.0, 0.0 if level else 0.25 / 0.2 - 0.25]), atol=1e-9)


def fits(**scores: float) -> list[FamilyFit]:
    specs = {
        "hencky": ELASTIC,
        "von_mises": PLASTIC,
        "drucker_prager": law("hencky", "drucker_prager", friction_angle=30),
        "neo_hookean": law("neo_hookean"),
    }
    return [FamilyFit(Family(name, specs[name]), {}, score=score) for name, score in scores.items()]


def test_near_scores_are_ties_unless_one_family_contains_the_chosen_one():
    options = settings({"hencky": ELASTIC}, tie=0.1)
    best, ties = select_family(
        fits(hencky=-8.0, von_mises=-7.95, neo_hookean=-7.95, drucker_prager=-7.8), options
    )
    assert best.family.name == "hencky" and ties == ["neo_hookean"]
    best, ties = select_family(fits(hencky=-7.95, von_mises=-8.0), options)
    assert best.family.name == "von_mises" and ties == ["hencky"]
    with pytest.raises(NonFiniteError, match="every candidate"):
        select_family(fits(hencky=math.inf), options)


def test_stiffness_that_the_time_step_does_not_bear_has_a_difference_too():
    """At the stiffest that dt bears no small step changes the law: the difference is taken over a long one."""
    body, seen = video_of(ELASTIC, V0, FRAMES)
    chosen = settings({"hencky": ELASTIC}, covariance_from="elastic", refined_particles=0)
    video, family = VideoResiduals(MODEL, known(body), body, seen, chosen), Family("hencky", ELASTIC)
    run = FamilyRun(family, [video], [len(FRAMES)], chosen)
    run._origin = family.unbounded({"E": 1e9, "nu": 0.3})
    run._u[0] = math.log(run.values["E"] / 1e9) + 0.5  # beyond the limit by more than a small step
    here = run._residual(run._u)
    by_stiffness, by_nu = run._constant_columns(run._u, here)
    assert by_stiffness[0].abs().max() > 0 and by_nu[0].isfinite().all()


def test_a_plastic_family_starts_from_weak_flow_and_from_fits_of_others(monkeypatch):
    """From its guesses and weaker limits of the last one, and from an elastic fit, then nearer to its elastic limit."""
    starts = []

    class Run(SimpleNamespace):
        alive = True

        def resembles(self, other):
            return False

        def begin(self, given, below):
            starts.append([(values["E"], values["yield_stress"]) for values in given])

    fit = SimpleNamespace(cost=1.0)
    monkeypatch.setattr(
        identification, "FamilyRun", lambda family, *given: Run(family=family, fit=fit, loss=1.0, rollouts=1)
    )
    elastic = Run(family=Family("elastic", ELASTIC), fit=fit, values={"E": 5e4, "nu": 0.2})
    family = Family("plastic", law("hencky", "von_mises", E=3e4, nu=0.3, yield_stress=4e3))
    published = {"E": 6e4, "nu": 0.3, "yield_stress": 8e3}
    guesses = [family.guess, family.with_guesses(published)]
    best = _first_fit(family, [], [elastic], guesses, settings({"elastic": ELASTIC}))
    (first, second), guess = starts, (3e4, 4e3)
    assert first == [pytest.approx(each) for each in (guess, (6e4, 8e3), (6e4, 2e3), (6e4, 500.0))]
    limit = second[0][1]  # the elastic fit is the best one, and that of a family that this one contains
    assert second == [pytest.approx((5e4, factor * limit)) for factor in (1, 1, 4, 16)]
    assert best.rollouts == 2
