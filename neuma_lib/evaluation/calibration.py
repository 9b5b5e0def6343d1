"""Intervals and probabilities of an identification whose coverage was measured.

The standard deviations of an identification rank its uncertainties, but its errors in units of them are not normal:
many are small, and a few are large. An interval at a level therefore extends by the quantile of |error| / std at that
level among scenes with a known truth (split conformal prediction: Papadopoulos et al. 2002, Lei et al. 2018).
Probabilities of families follow from their scores with a temperature (Guo et al. 2017) from the same scenes.

``calibration.json`` has the quantiles, the temperature and their source. `python -m benchmarks.calibration` writes it
from scenes of development seeds. Quantities that it does not have are normal, and the temperature is 1.
"""

import json
import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from statistics import NormalDist
from typing import Any

import numpy as np

from neuma_lib.errors import InputError

FILE = Path(__file__).with_suffix(".json")
LEVELS = tuple(round(0.05 * n, 2) for n in range(1, 20))
"""Levels with a measured quantile. Others between 0 and the last are interpolated."""
SHOWN = 0.95  # level of the intervals and bands in tables and figures
MATERIAL, GRID = "material", "grid"
MOTION = {MATERIAL: "motion of the material", GRID: "motion on the grid"}
QUANTITIES = (MATERIAL, GRID, *MOTION.values())
"""Calibrated quantities: constants extrapolated to a cell size of zero, those on the grid of the fit, and motions that
are predicted with either."""
_MAX_LOG = 700.0  # without overflow


@dataclass(frozen=True)
class Quantiles:
    """Quantiles of |error| / std at `LEVELS`."""

    values: tuple[float, ...]

    def at(self, level: float) -> float:
        """The quantile at a level. Raises InputError if it is not between 0 and the last of `LEVELS`."""
        if not 0 <= level <= LEVELS[-1]:
            raise InputError("level", f"{level!r} must be between 0 and {LEVELS[-1]}")
        return float(np.interp(level, (0.0, *LEVELS), (0.0, *self.values)))

    def nominal(self, level: float) -> float:
        """Probability that a normal variable is within the quantile at a level.

        The central interval of normal samples with this probability is the calibrated one at the level, also of any
        monotone function of them (Kuleshov et al. 2018).
        """
        return 2 * NormalDist().cdf(self.at(level)) - 1


NORMAL = Quantiles(tuple(NormalDist().inv_cdf((1 + level) / 2) for level in LEVELS))


@cache
def stored() -> Mapping[str, Any]:
    """Content of ``calibration.json``: ``quantiles`` by quantity, ``temperature`` and ``source``; empty without one."""
    return json.loads(FILE.read_text()) if FILE.exists() else {}


def quantiles_of(quantity: str) -> Quantiles:
    """The stored quantiles of one of `QUANTITIES`, `NORMAL` if there are none."""
    known = stored().get("quantiles", {}).get(quantity)
    return Quantiles(tuple(known)) if known else NORMAL


def kind_of(identified: Mapping[str, Any]) -> str:
    """Whether the content of an identified.json has constants of the `MATERIAL`, or only those on the `GRID`."""
    return MATERIAL if MATERIAL in identified else GRID


def interval(
    value: float, log_std: float, level: float = SHOWN, quantity: str = MATERIAL
) -> tuple[float, float]:
    """Interval that contains a positive constant with the probability ``level``.

    Args:
        value: identified constant.
        log_std: estimated standard deviation of its logarithm.
        level: at most 0.95.
        quantity: `MATERIAL` or `GRID`.
    """
    factor = math.exp(min(quantiles_of(quantity).at(level) * log_std, _MAX_LOG))
    return value / factor, value * factor


def family_probabilities(identified: Mapping[str, Any], temperature: float | None = None) -> dict[str, float]:
    """Probability of each family that was compared, p ~ exp(-score / temperature), the most probable first.

    It is that of the family among the candidates. Others have none.

    Args:
        identified: content of identified.json.
        temperature: None: the stored one.
    """
    temperature = temperature or stored().get("temperature", 1.0)
    names = identified.get("compared", ())
    scores = np.array([identified["families"][name]["score"] for name in names])
    weights = np.exp((scores.min() - scores) / temperature) if len(scores) else scores
    ranked = sorted(zip(names, (weights / weights.sum()).tolist(), strict=True), key=lambda pair: -pair[1])
    return dict(ranked)


def describe_families(identified: Mapping[str, Any]) -> str:
    """Families with their probabilities in percent, without those below 1 %."""
    known = family_probabilities(identified)
    return ", ".join(f"{name} {100 * p:.0f} %" for name, p in known.items() if p >= 0.01)
