"""Arcs of free flight in the pictures of one camera: which of the things that moved is the one that flew.

A hand that throws is often larger than what it throws, and moves as well. In free flight a place in the picture is
nearly a parabola of time, which neither a hand, nor noise, nor a shadow that passes over an edge keeps to for long. An
arc is begun from three candidates at equal spacings, and grows to both sides while a candidate lies on it.

Places are (x, y) [px], pixel centres at +0.5.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

LEAST_FRAMES = 5
"""Frames of an arc: a parabola passes through any three."""
LEAST_TRAVEL = 1.0
"""Way along an arc, in diameters: what rests moves on a parabola, too."""
MOST_CANDIDATES = 5
"""Things in a picture that are looked at, the largest."""
_OFF = 0.35  # distance from the arc that still is on it, in radii
_OFF_LEAST = 2.0  # [px]
_RATIO = 2.5  # of areas that may belong together; motion blurs
_SPACINGS = (1, 2, 4, 8, 16)  # frames between the three that begin an arc
_GAP = 2  # frames in which the object may be missed


@dataclass(frozen=True, eq=False)
class Arc:
    """A stretch of free flight.

    Attributes:
        frames: numbers of the first and of the last frame on it.
        found: frame -> number of the candidate on it; frames in which it was missed are left out.
        start: time that the coefficients count from [s].
        coefficients: place = c0 + c1 t + c2 t^2, (3, 2) [px].
        area: usual area of the candidates [px].
    """

    frames: tuple[int, int]
    found: dict[int, int]
    start: float
    coefficients: np.ndarray
    area: float

    def place(self, time: float | np.ndarray) -> np.ndarray:
        """(..., 2) at a time [s]."""
        t = np.asarray(time, float)[..., None] - self.start
        return self.coefficients[0] + self.coefficients[1] * t + self.coefficients[2] * t**2

    @property
    def reach(self) -> float:
        """Distance from the arc that still is on it [px]."""
        return max(_OFF_LEAST, _OFF * float(np.sqrt(self.area / np.pi)))


def find_arcs(
    candidates: Sequence[np.ndarray], times: np.ndarray, down: np.ndarray | None = None
) -> list[Arc]:
    """Arcs in the order of time, none of which shares a frame with another; the longest are taken first.

    Args:
        candidates: of each of T frames, x, y and area of what moved and does not touch the picture's border, (N, 3).
        times: [s], ascending, (T,).
        down: the way in which things fall in the picture, (2,): a body that bounces keeps to a parabola as well, which
            is curved upward. None: not known.
    """
    times = np.asarray(times, float)
    table = np.full((len(times), MOST_CANDIDATES, 3), np.nan)
    order = []
    for row, found in zip(table, candidates):
        largest = np.argsort(-found[:, 2], kind="stable")[:MOST_CANDIDATES]
        order.append(largest)
        row[: len(largest)] = found[largest]
    arcs: list[Arc] = []
    while (best := _longest(table, times, down)) is not None:
        first, last = best.frames
        table[first : last + 1] = np.nan
        arcs.append(
            Arc(
                best.frames,
                {i: int(order[i][c]) for i, c in best.found.items()},
                best.start,
                best.coefficients,
                best.area,
            )
        )
    return sorted(arcs, key=lambda arc: arc.frames)


def _longest(table: np.ndarray, times: np.ndarray, down: np.ndarray | None) -> Arc | None:
    best: Arc | None = None
    for spacing in _SPACINGS:
        for middle in range(spacing, len(times) - spacing):
            three = [middle - spacing, middle, middle + spacing]
            for chosen in np.ndindex(*(int(np.isfinite(table[i, :, 0]).sum()) for i in three)):
                if best is not None and all(best.found.get(i) == c for i, c in zip(three, chosen)):
                    continue  # would grow into the same
                arc = _grown(table, times, three, chosen)
                if arc is not None and down is not None and arc.coefficients[2] @ down <= 0:
                    continue
                if arc is not None and (best is None or len(arc.found) > len(best.found)):
                    best = arc
    return best


def _grown(table: np.ndarray, times: np.ndarray, three: list[int], chosen: tuple[int, ...]) -> Arc | None:
    """The arc through three candidates, refitted to what lies on it until that stays the same."""
    areas = table[three, chosen, 2]
    if areas.max() > _RATIO * areas.min():
        return None
    found = dict(zip(three, chosen))
    for _ in range(5):
        start = times[three[1]]
        area = float(np.median([table[i, c, 2] for i, c in found.items()]))
        fitted = Arc((0, 0), found, start, _fit(table, times, found, start), area)
        again = _on(table, times, fitted, three[1])
        if len(again) < 3 or again == found:
            break
        found = again
    if len(found) < LEAST_FRAMES:
        return None
    first, last = min(found), max(found)
    places = fitted.place(times[first : last + 1])
    travel = np.linalg.norm(np.diff(places, axis=0), axis=1).sum()
    if travel < LEAST_TRAVEL * 2 * np.sqrt(area / np.pi):
        return None
    return Arc((first, last), found, start, fitted.coefficients, area)


def _fit(table: np.ndarray, times: np.ndarray, found: dict[int, int], start: float) -> np.ndarray:
    frames = list(found)
    t = times[frames] - start
    return np.linalg.lstsq(
        np.stack([np.ones_like(t), t, t * t], axis=1), table[frames, list(found.values()), :2], rcond=None
    )[0]


def _on(table: np.ndarray, times: np.ndarray, arc: Arc, middle: int) -> dict[int, int]:
    """Candidates on an arc, around a frame and without a gap longer than `_GAP` frames."""
    off = np.linalg.norm(table[..., :2] - arc.place(times)[:, None], axis=2)
    with np.errstate(invalid="ignore"):
        alike = np.abs(np.log(table[..., 2] / arc.area)) < np.log(_RATIO)
    off = np.where(alike & np.isfinite(off), off, np.inf)
    nearest = off.argmin(axis=1)
    on = off[np.arange(len(off)), nearest] <= arc.reach
    found: dict[int, int] = {}
    for frames in (range(middle, len(on)), range(middle - 1, -1, -1)):
        missed = 0
        for i in frames:
            missed = 0 if on[i] else missed + 1
            if missed > _GAP:
                break
            if on[i]:
                found[i] = int(nearest[i])
    return dict(sorted(found.items()))
