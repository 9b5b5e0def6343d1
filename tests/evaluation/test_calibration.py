"""Calibrated intervals have the stated coverage for errors of another distribution than the normal one."""

import math
from statistics import NormalDist

import numpy as np
import pytest
import torch

from benchmarks.calibration import measured_quantiles
from neuma_lib.evaluation import calibration
from neuma_lib.evaluation.bands import band
from neuma_lib.evaluation.calibration import (
    GRID,
    LEVELS,
    MATERIAL,
    NORMAL,
    QUANTITIES,
    describe_families,
    family_probabilities,
    interval,
    kind_of,
    quantiles_of,
)
from tests.support.errors import refused

pytestmark = pytest.mark.core
SHOWN = (0.5, 0.8, 0.95)


def student(count: int, seed: int, freedom: float = 1.5) -> np.ndarray:
    """Errors in estimated standard deviations, with a few large ones."""
    return 0.35 * np.random.default_rng(seed).standard_t(freedom, count)


@pytest.fixture
def use(monkeypatch):
    """A function that replaces the stored calibration."""

    def replace(**content):
        monkeypatch.setattr(calibration, "stored", lambda: content)

    return replace


def test_measured_quantiles_cover_new_errors_and_normal_ones_do_not():
    """Of new errors of the same distribution, to five standard deviations of both samples' counts.

    Normal intervals are far too wide at the lower levels.
    """
    measured, new = measured_quantiles(student(4000, 0)), np.abs(student(20_000, 1))
    for level in SHOWN:
        covered = (new <= measured.at(level)).mean()
        std = math.sqrt(level * (1 - level) * (1 / 4000 + 1 / 20_000))
        assert abs(covered - level) < 5 * std
        assert level == 0.95 or (new <= NORMAL.at(level)).mean() - level > 10 * std


def test_few_errors_are_covered_on_average():
    """Over many draws of nine errors, a tenth is below the quantile at a level with at least this probability, and at
    most 1/10 more (Lei et al. 2018, Theorem 2.1)."""
    trials, level = 4000, 0.5
    draws = np.stack([student(10, seed) for seed in range(trials)])
    covered = np.mean([abs(z[9]) <= measured_quantiles(z[:9]).at(level) for z in draws])
    assert level - 5 * 0.5 / math.sqrt(trials) <= covered <= level + 0.1 + 5 * 0.5 / math.sqrt(trials)


def test_quantiles_of_normal_errors_are_those_of_the_normal_distribution():
    measured = measured_quantiles(np.random.default_rng(2).standard_normal(40_000))
    np.testing.assert_allclose(measured.values, NORMAL.values, atol=0.03)
    assert NORMAL.at(0.95) == pytest.approx(1.95996, abs=1e-5)
    assert [NORMAL.nominal(level) for level in SHOWN] == pytest.approx(SHOWN)
    assert NORMAL.at(0.0) == 0 and NORMAL.at(0.5) < NORMAL.at(0.525) < NORMAL.at(0.55)
    for level in (0.99, -0.1, math.nan):
        with refused("level"):
            NORMAL.at(level)


def test_no_errors_are_refused():
    with refused("errors"):
        measured_quantiles([])


def test_intervals_have_the_stored_width(use):
    """In logarithms, about the value; a constant without information is no overflow."""
    use(quantiles={GRID: [2 * q for q in NORMAL.values]})
    low, high = interval(3e4, 0.1, 0.8, GRID)
    assert math.log(high / 3e4) == pytest.approx(0.2 * NORMAL.at(0.8)) == math.log(3e4 / low)
    low, high = interval(3e4, 0.1, 0.8, MATERIAL)
    assert math.log(high / 3e4) == pytest.approx(0.1 * NORMAL.at(0.8))
    assert interval(1.0, 1e4)[1] < math.inf
    assert kind_of({"material": {}, "best": {}}) == MATERIAL and kind_of({"best": {}}) == GRID


def test_a_band_is_the_calibrated_interval_of_a_monotone_function(use):
    """Curves exp(u) of normal constants: the band is exp of the calibrated interval of u."""
    use(quantiles={GRID: [0.5 * q for q in NORMAL.values]})
    draws = 0.3 * torch.randn(20_000, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    low, high = band(list(draws), lambda u: u.exp()[None])
    reach = 0.3 * 0.5 * NORMAL.at(0.95)
    assert math.log(high[0]) == pytest.approx(reach, abs=0.01)
    assert math.log(low[0]) == pytest.approx(-reach, abs=0.01)


def test_probabilities_follow_from_scores(use):
    """The ratio of two probabilities is exp of the difference of the scores over the temperature."""
    scores = {"a": -5.0, "b": -4.6, "c": -9.0}
    identified = {
        "families": {name: {"score": score} for name, score in scores.items()},
        "compared": ["b", "a"],
    }
    use(temperature=0.2)
    known = family_probabilities(identified)
    assert list(known) == ["a", "b"]  # c is of another grid
    assert known["a"] / known["b"] == pytest.approx(math.exp(2)) and sum(known.values()) == pytest.approx(1)
    assert describe_families(identified) == "a 88 %, b 12 %"
    use()
    assert family_probabilities(identified)["a"] == pytest.approx(1 / (1 + math.exp(-0.4)))
    assert family_probabilities({"families": {}}) == {}


def test_the_stored_calibration_is_complete():
    """If one has been written: quantiles of known quantities that grow with the level, from development scenes."""
    content = calibration.stored()
    for quantity, values in content.get("quantiles", {}).items():
        assert quantity in QUANTITIES and len(values) == len(LEVELS)
        assert (np.diff(values) >= 0).all() and values[0] >= 0
    assert not content or content["source"]["scenes"]
    assert quantiles_of("unknown") is NORMAL
    assert NormalDist().cdf(NORMAL.values[-1]) == pytest.approx(0.975)
