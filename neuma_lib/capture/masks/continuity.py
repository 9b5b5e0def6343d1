"""Continuity of a tracked object in place, area, shape and colour, and the frames in which it is broken.

A tracker that loses an object finds another one: a ruler on the table, a hand, the shadow. From one frame to the next
an object moves no faster than in its flight, and its area, its elongation and its colours hardly change.

Pictures are RGB, uint8, (H, W, 3). Masks are Boolean, (H, W).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np
from scipy import ndimage

MAX_SPEED = 1.5
"""Tolerated speed in the picture, relative to the largest one in flight, in addition to a radius per frame."""
MAX_AREA_RATIO = 1.8
"""Tolerated ratio of the areas of consecutive masks. An impact at 60 frames per second changes it by up to 1.5."""
MAX_ELONGATION_RATIO = 1.8
"""Tolerated ratio of the elongations, the square roots of the ratios of the principal variances."""
MIN_COLOURS = 0.5
"""Bhattacharyya coefficient between the colours in a frame and those in flight (1: equal, 0: disjoint)."""
MAX_GAP = 2
"""Number of frames in which the object may be missing or left out. After more, the track ends."""
_BINS = 12  # of each channel
_SPREAD = 1.0  # standard deviation of exposure and noise, in bins
_MIN_PIXELS = 30  # for the colours of a frame


class Appearance(NamedTuple):
    """What is compared: centre (x, y) [px], area [px], elongation >= 1, and square roots of colour frequencies."""

    centre: np.ndarray
    area: float
    elongation: float
    colours: np.ndarray | None


class Break(NamedTuple):
    """Frames, first and last, that are left out, and the reason."""

    first: int
    last: int
    reason: str

    def __str__(self) -> str:
        frames = f"frame {self.first}" if self.first == self.last else f"frames {self.first} to {self.last}"
        return f"{frames}: {self.reason}"

    def plain(self) -> dict[str, Any]:
        """Entries of a report."""
        return self._asdict()


def appearance(picture: np.ndarray, mask: np.ndarray) -> Appearance | None:
    """Appearance of the object in a frame. None if the mask is empty."""
    rows, columns = np.nonzero(mask)
    if len(rows) == 0:
        return None
    variances = np.linalg.eigvalsh(np.cov(np.stack([columns, rows])) if len(rows) > 1 else np.zeros((2, 2)))
    low, high = np.sqrt(np.maximum(variances, 0) + 1 / 12)
    centre = np.array([columns.mean(), rows.mean()]) + 0.5
    return Appearance(centre, float(len(rows)), float(high / low), _colours(picture[rows, columns]))


def _colours(pixels: np.ndarray) -> np.ndarray | None:
    if len(pixels) < _MIN_PIXELS:
        return None
    counts = np.zeros((_BINS,) * 3)
    np.add.at(counts, tuple(np.moveaxis(pixels.astype(int) * _BINS // 256, -1, 0)), 1)
    smooth = ndimage.gaussian_filter(counts, _SPREAD, mode="nearest")
    return np.sqrt(smooth / smooth.sum()).ravel()


def broken_frames(
    seen: Sequence[Appearance | None], times: np.ndarray, flight: tuple[int, int]
) -> list[tuple[int, str]]:
    """Frames in which something else than the object is in the mask, with reasons, in order.

    Frames are compared with the last good one, from the flight on in both directions.

    Args:
        seen: appearance in each of T frames, None where the object was not detected.
        times: of the frames [s], ascending, (T,).
        flight: first and last frame in which the object is known.
    """
    known = [i for i in range(flight[0], flight[1] + 1) if seen[i] is not None]
    if len(known) < 2:
        return []
    centres = np.stack([seen[i].centre for i in known])
    fastest = (np.linalg.norm(np.diff(centres, axis=0), axis=1) / np.diff(times[known])).max()
    colours = [seen[i].colours for i in known if seen[i].colours is not None]
    usual = np.sqrt(np.mean(np.square(colours), axis=0)) if colours else None
    broken: dict[int, str] = {}
    for order, start in (
        (range(flight[1] + 1, len(seen)), known[-1]),
        (range(flight[0] - 1, -1, -1), known[0]),
    ):
        last, ended = start, ""
        for i in order:
            now = seen[i]
            if not ended and abs(i - last) > MAX_GAP + 1:
                ended = f"the track ends at frame {last}"
                if cause := [broken[k] for k in range(min(i, last), max(i, last) + 1) if k in broken]:
                    ended += f", after which {cause[0 if order.step > 0 else -1]}"
            if now is None:
                continue
            reason = ended or _difference(seen[last], now, fastest * abs(times[i] - times[last]), usual)
            if reason:
                broken[i] = reason
            else:
                last = i
    return sorted(broken.items())


def _difference(before: Appearance, now: Appearance, way: float, usual: np.ndarray | None) -> str:
    """What distinguishes two masks that cannot show the same object. Empty if they can."""
    moved = float(np.linalg.norm(now.centre - before.centre))
    limit = MAX_SPEED * way + np.sqrt(before.area / np.pi)
    if moved > limit:
        return f"its place jumps by {moved:.0f} px, {limit:.0f} px are possible"
    ratios: list[tuple[str, Callable[[Appearance], float], float]] = [
        ("area", lambda a: a.area, MAX_AREA_RATIO),
        ("elongation", lambda a: a.elongation, MAX_ELONGATION_RATIO),
    ]
    for name, value, limit in ratios:
        ratio = max(value(now) / value(before), value(before) / value(now))
        if ratio > limit:
            return f"its {name} changes by a factor of {ratio:.1f}, the limit is {limit:g}"
    if usual is not None and now.colours is not None and (same := float(usual @ now.colours)) < MIN_COLOURS:
        return f"its colours differ from those in flight (agreement {same:.2f}, at least {MIN_COLOURS} is required)"
    return ""


def grouped(broken: Sequence[tuple[int, str]]) -> list[Break]:
    """Consecutive frames with the same reason as one."""
    breaks: list[Break] = []
    for number, reason in broken:
        if breaks and breaks[-1].last == number - 1 and breaks[-1].reason == reason:
            breaks[-1] = breaks[-1]._replace(last=number)
        else:
            breaks.append(Break(number, number, reason))
    return breaks
