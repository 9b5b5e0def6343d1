"""Response of laws in tests of a material point, over the range of states of a motion."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
import torch
from torch import Tensor

from neuma_lib.evaluation.bands import band
from neuma_lib.evaluation.material_point import Visited, largest_shear_stress, sheared, uniaxial, yielding
from neuma_lib.mechanics.law import Law

BEYOND = 1.6  # range of the tests relative to the visited range, measured from the undeformed state
SMALLEST_STRETCH = 0.05
POINTS = 121  # points of a curve
EVERY = 5  # points of a curve per point of its band


@dataclass(frozen=True)
class PointTest:
    """A test of a material point."""

    x: Tensor  # prescribed values, (P,)
    curve: Callable[[Law, Tensor], Tensor]  # stresses (P',) [Pa] of a law at some of these
    visited: tuple[float, float]  # visited range of x, or of the stress [Pa] if ``by_stress``
    by_stress: bool = False


def material_tests(truth: Law, F: Tensor, rate: float, total_shear: float, dt: float) -> dict[str, PointTest]:
    """Uniaxial stretch and shear of the elastic law, and shear at a constant rate with the return map.

    Args:
        truth: the true law, which gives the largest visited stress.
        F: visited elastic deformation gradients (S, 3, 3).
        rate: of the last test [1/s].
        total_shear: at its end.
        dt: time step [s].
    """
    return tests_within(Visited.of(F), largest_shear_stress(truth, F), rate, total_shear, dt)


def tests_within(
    seen: Visited, shear_stress: float, rate: float, total_shear: float, dt: float
) -> dict[str, PointTest]:
    """The tests of `material_tests` for known ranges of visited states and their largest shear stress [Pa]."""
    low, high = (1 + BEYOND * (end - 1) for end in seen.stretch)
    steps = round(total_shear / (rate * dt))
    total = rate * dt * torch.arange(steps + 1, dtype=torch.float64)

    def flow(law: Law, x: Tensor) -> Tensor:
        return yielding(law, rate, dt, steps, seen.pressed)[torch.searchsorted(total, x)]

    return {
        "uniaxial": PointTest(_axis(max(low, SMALLEST_STRETCH), high), uniaxial, seen.stretch),
        "shear": PointTest(
            _axis(*(BEYOND * s for s in seen.shear)), partial(sheared, J=seen.pressed), seen.shear
        ),
        "yield": PointTest(total, flow, (0.0, shear_stress), by_stress=True),
    }


def response(law: Law, truth: Law, test: PointTest, draws: Sequence[Law] = ()) -> dict[str, Any]:
    """Curves of a law and of the true one in a test, and a band of sampled laws, as plain numbers.

    Returns:
        ``x``, ``visited``, ``by_stress``, ``stress`` and ``true`` [Pa]; with samples, ``band`` with its own ``x``,
        ``low`` and ``high``.
    """
    curves: dict[str, Any] = {
        "x": test.x.tolist(),
        "visited": list(test.visited),
        "by_stress": test.by_stress,
        "stress": test.curve(law, test.x).tolist(),
        "true": test.curve(truth, test.x).tolist(),
    }
    if draws:
        curves["band"] = band_of_test(test, draws)
    return curves


def band_of_test(test: PointTest, draws: Sequence[Law], scale: float = 1.0) -> dict[str, list[float]]:
    """Band of sampled laws at every `EVERY`-th point: ``x``, and ``low`` and ``high`` [Pa] times ``scale``."""
    x = test.x[::EVERY].contiguous()
    low, high = band(draws, lambda law: test.curve(law, x))
    return {"x": x.tolist(), "low": (scale * low).tolist(), "high": (scale * high).tolist()}


def inside(curves: Mapping[str, Any]) -> float | None:
    """Share of the visited points of a band at which the true curve lies in it. None without visited points."""
    true, low, high = _visited_band(curves)
    return float(((low <= true) & (true <= high)).mean()) if len(true) else None


def half_width(curves: Mapping[str, Any]) -> float | None:
    """Half width of a band relative to the true curve, of root mean squares over the visited points.

    None without visited points.
    """
    true, low, high = _visited_band(curves)
    return float(np.sqrt(((high - low) ** 2).mean() / (4 * (true**2).mean()))) if len(true) else None


def _visited_band(curves: Mapping[str, Any]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The true curve and the ends of the band at the visited points of the band."""
    x, low, high = (np.array(curves["band"][key]) for key in ("x", "low", "high"))
    true = np.interp(x, curves["x"], curves["true"])
    start, end = curves["visited"]
    where = true if curves["by_stress"] else x
    seen = (where >= start) & (where <= end)
    return true[seen], low[seen], high[seen]


def _axis(low: float, high: float) -> Tensor:
    return torch.linspace(low, high, POINTS, dtype=torch.float64)
