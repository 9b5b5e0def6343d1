"""Coverage and scores of intervals and probabilities, with their confidence over independent scenes."""

from collections.abc import Mapping, Sequence, Set
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

BOOTSTRAP = 2000  # resamplings of the scenes
CONFIDENCE = 0.95


@dataclass(frozen=True)
class Intervals:
    """Intervals at a level and the truths, of one scene."""

    # low, high: ends
    low: np.ndarray
    high: np.ndarray
    truth: np.ndarray  # true values, of the same shape

    @property
    def covered(self) -> np.ndarray:
        """Whether each truth is inside."""
        return (self.low <= self.truth) & (self.truth <= self.high)

    @property
    def width(self) -> np.ndarray:
        return self.high - self.low

    def score(self, level: float) -> np.ndarray:
        """Interval score (Gneiting and Raftery 2007, Eq. 43), lower is better: the width, and 2 / (1 - level) times
        the distance of a truth outside."""
        outside = np.maximum(self.low - self.truth, 0) + np.maximum(self.truth - self.high, 0)
        return self.width + 2 / (1 - level) * outside


def mean_over_scenes(values: Sequence[np.ndarray], seed: int = 0) -> tuple[float, float, float]:
    """Mean of all values, and its confidence interval by a bootstrap over the scenes.

    Args:
        values: of each scene, which are dependent. Scenes are independent.
    """
    sums, counts = (np.array([measure(v) for v in values], dtype=float) for measure in (np.sum, np.size))
    times = _times_drawn(len(values), seed)
    means = times @ sums / (times @ counts)
    low, high = np.quantile(means, [(1 - CONFIDENCE) / 2, (1 + CONFIDENCE) / 2])
    return float(sums.sum() / counts.sum()), float(low), float(high)


@lru_cache(maxsize=8)
def _times_drawn(scenes: int, seed: int) -> np.ndarray:
    """How often each scene is in each resampling, shape (`BOOTSTRAP`, scenes)."""
    even = np.full(scenes, 1 / scenes)
    return np.random.default_rng(seed).multinomial(scenes, even, BOOTSTRAP).astype(float)


def brier_score(probabilities: Mapping[str, float], right: Set[str]) -> float:
    """Brier score of the probabilities of families (Brier 1950), 0 to 2, lower is better.

    Args:
        probabilities: of families by name. Others have none.
        right: names of the true family, which may have several.
    """
    hit = sum(p for name, p in probabilities.items() if name in right)
    return (1 - hit) ** 2 + sum(p**2 for name, p in probabilities.items() if name not in right)
