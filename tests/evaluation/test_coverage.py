"""Scores of intervals and probabilities, and their confidence over scenes."""

import math

import numpy as np
import pytest

from benchmarks.calibration import TEMPERATURES, fitted_temperature
from neuma_lib.evaluation.calibration import NORMAL
from neuma_lib.evaluation.coverage import Intervals, brier_score, mean_over_scenes

pytestmark = pytest.mark.core


def test_the_interval_score_is_width_and_penalty():
    own = Intervals(np.array([0.0, 0.0, 0.0]), np.array([2.0, 2.0, 2.0]), np.array([1.0, 2.5, -1.0]))
    assert own.covered.tolist() == [True, False, False]
    np.testing.assert_allclose(own.score(0.8), [2, 2 + 10 * 0.5, 2 + 10 * 1.0])


def test_the_interval_score_is_proper():
    """Of normal errors, central intervals of another width have a higher mean score at every level."""
    truth = np.random.default_rng(0).standard_normal(200_000)

    def score(factor: float, level: float) -> float:
        reach = np.full(len(truth), factor * NORMAL.at(level))
        return float(Intervals(-reach, reach, truth).score(level).mean())

    for level in (0.5, 0.8, 0.95):
        assert score(1.0, level) < min(score(0.8, level), score(1.25, level))


def test_confidence_is_that_of_independent_scenes():
    """Values of a scene are equal. The interval contains the mean of all scenes in 95 % of the trials."""
    trials, scenes, hits = 400, 30, 0
    for seed in range(trials):
        own = np.random.default_rng(seed).standard_normal(scenes)
        mean, low, high = mean_over_scenes([np.full(1 + k % 3, value) for k, value in enumerate(own)], seed)
        assert low <= mean <= high
        hits += low <= 0 <= high
    std = math.sqrt(trials * 0.95 * 0.05)
    assert (
        0.90 * trials - 4 * std <= hits <= 0.95 * trials + 4 * std
    )  # a bootstrap of few scenes is a little short
    one, low, high = mean_over_scenes([np.array([1.0, 3.0])])
    assert one == low == high == 2


def test_the_brier_score():
    assert brier_score({"a": 1.0}, {"a"}) == 0
    assert brier_score({"a": 1.0}, {"b"}) == 2
    assert brier_score({"a": 0.5, "b": 0.5}, {"a"}) == pytest.approx(0.5)
    assert brier_score({"a": 0.5, "b": 0.3, "c": 0.2}, {"a", "b"}) == pytest.approx(0.08)


@pytest.mark.parametrize("temperature", [0.1, 0.5])
def test_the_temperature_of_scores_is_recovered(temperature):
    """Truths drawn with the probabilities of a temperature: the fitted one is within a quarter of it."""
    generator, scenes = np.random.default_rng(3), []
    for _ in range(1500):
        scores = temperature * generator.normal(0, 2, 3)
        p = np.exp(-scores / temperature)
        right = generator.choice(3, p=p / p.sum())
        families = {str(k): {"score": score} for k, score in enumerate(scores)}
        scenes.append(({"families": families, "compared": list(families)}, {str(right)}))
    assert fitted_temperature(scenes) == pytest.approx(temperature, rel=0.25)
    assert TEMPERATURES[0] < temperature < TEMPERATURES[-1]
