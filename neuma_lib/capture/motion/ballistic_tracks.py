"""Detect ballistic tracks among the moving regions of one camera.

A hand that launches an object is often larger than the object and moves too. In free flight the position in the picture
is nearly a quadratic function of time. Hands, noise and shadows follow a parabola only briefly. What rolls through the
background follows a line. A track starts from three candidates at equal spacings and grows in both directions while
candidates lie on it.

Positions are (x, y) [px], pixel centres at +0.5.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

MIN_FRAMES = 5  # frames of a track: a parabola passes through any three
_MIN_TRAVEL = 1.0  # path length of a track, in diameters: resting objects fit a parabola, too
_MAX_CANDIDATES = 5  # per picture, the largest ones
_TOLERANCE = 0.35  # distance from the track, in radii
_MIN_TOLERANCE = 2.0  # [px]
_MAX_AREA_RATIO = 2.5  # within a track; motion blur changes areas
_SPACINGS = (1, 2, 4, 8, 16)  # frames between the three candidates that start a track
_MIN_DEPTH = 0.5  # of the curve of a track, as share of that of another one, with which both may be flights
_MAX_GAP = 2  # frames in which the object may be missed


@dataclass(frozen=True, eq=False)
class BallisticTrack:
    """A segment of free flight."""

    frames: tuple[int, int]  # numbers of its first and last frame
    # frame -> number of the candidate on the track; frames in which it was missed are left out
    candidates: dict[int, int]
    start: float  # time origin of the coefficients [s]
    coefficients: np.ndarray  # position = c0 + c1 t + c2 t^2, (3, 2) [px]
    area: float  # median area of the candidates [px]

    def place(self, time: float | np.ndarray) -> np.ndarray:
        """Position (..., 2) [px] at a time [s]."""
        t = np.asarray(time, float)[..., None] - self.start
        return self.coefficients[0] + self.coefficients[1] * t + self.coefficients[2] * t**2

    @property
    def reach(self) -> float:
        """Tolerated distance from the track [px]."""
        return max(_MIN_TOLERANCE, _TOLERANCE * float(np.sqrt(self.area / np.pi)))


def find_ballistic_tracks(
    candidates: Sequence[np.ndarray], times: np.ndarray, down: np.ndarray | None = None
) -> list[BallisticTrack]:
    """Tracks in order of time, without shared frames. The longest ones are selected first.

    What rolls or is carried moves along a line, possibly longer than the object flies. So a track of which the curve is
    less than half as deep gives way, and so does one with less than half of the acceleration of the first.

    Args:
        candidates: x, y and area of moving regions that do not touch the picture's border, (N, 3) for each of T frames.
        times: [s], ascending, (T,).
        down: direction of gravity in the picture, (2,). It rejects the upward parabola of a bounce. None if unknown.
    """
    times = np.asarray(times, float)
    table = np.full((len(times), _MAX_CANDIDATES, 3), np.nan)
    order = []
    for row, regions in zip(table, candidates):
        largest = np.argsort(-regions[:, 2], kind="stable")[:_MAX_CANDIDATES]
        order.append(largest)
        row[: len(largest)] = regions[largest]
    tracks: list[BallisticTrack] = []
    while (best := _longest(table, times, down)) is not None:
        if tracks and _depth(best) < _MIN_DEPTH * _depth(tracks[0]):
            break
        first, last = best.frames
        table[first : last + 1] = np.nan
        tracks.append(replace(best, candidates={i: int(order[i][c]) for i, c in best.candidates.items()}))
    return sorted(tracks, key=lambda track: track.frames)


def _longest(table: np.ndarray, times: np.ndarray, down: np.ndarray | None) -> BallisticTrack | None:
    def better(track: BallisticTrack, other: BallisticTrack) -> bool:
        depth, least = (_depth(each, np.ptp(times[list(each.frames)])) for each in (track, other))
        if min(depth, least) < _MIN_DEPTH * max(depth, least):
            return depth > least
        return len(track.candidates) > len(other.candidates)

    best: BallisticTrack | None = None
    for spacing in _SPACINGS:
        for middle in range(spacing, len(times) - spacing):
            three = [middle - spacing, middle, middle + spacing]
            for chosen in np.ndindex(*(int(np.isfinite(table[i, :, 0]).sum()) for i in three)):
                if best is not None and all(best.candidates.get(i) == c for i, c in zip(three, chosen)):
                    continue  # would grow into the same track
                track = _grown(table, times, three, chosen)
                if track is not None and down is not None and track.coefficients[2] @ down <= 0:
                    continue
                if track is not None and (best is None or better(track, best)):
                    best = track
    return best


def _depth(track: BallisticTrack, duration: float = 2.0) -> float:
    """Distance of the middle of a part of this duration [s] from the line through its ends [px]."""
    return float(np.linalg.norm(track.coefficients[2])) * (duration / 2) ** 2


def _grown(
    table: np.ndarray, times: np.ndarray, three: list[int], chosen: tuple[int, ...]
) -> BallisticTrack | None:
    """The track through three candidates, refitted to the candidates on it until these no longer change."""
    areas = table[three, chosen, 2]
    if areas.max() > _MAX_AREA_RATIO * areas.min():
        return None
    members = dict(zip(three, chosen))
    for _ in range(5):
        start = times[three[1]]
        area = float(np.median([table[i, c, 2] for i, c in members.items()]))
        fitted = BallisticTrack((0, 0), members, start, _fit(table, times, members, start), area)
        updated = _candidates_on(table, times, fitted, three[1])
        if len(updated) < 3 or updated == members:
            break
        members = updated
    if len(members) < MIN_FRAMES:
        return None
    first, last = min(members), max(members)
    places = fitted.place(times[first : last + 1])
    travel = np.linalg.norm(np.diff(places, axis=0), axis=1).sum()
    if travel < _MIN_TRAVEL * 2 * np.sqrt(area / np.pi):
        return None
    return BallisticTrack((first, last), members, start, fitted.coefficients, area)


def _fit(table: np.ndarray, times: np.ndarray, members: dict[int, int], start: float) -> np.ndarray:
    frames = list(members)
    t = times[frames] - start
    return np.linalg.lstsq(
        np.stack([np.ones_like(t), t, t * t], axis=1), table[frames, list(members.values()), :2], rcond=None
    )[0]


def _candidates_on(
    table: np.ndarray, times: np.ndarray, track: BallisticTrack, middle: int
) -> dict[int, int]:
    """Candidates on a track around a frame, without a gap longer than `_MAX_GAP` frames."""
    distance = np.linalg.norm(table[..., :2] - track.place(times)[:, None], axis=2)
    with np.errstate(invalid="ignore"):
        similar = np.abs(np.log(table[..., 2] / track.area)) < np.log(_MAX_AREA_RATIO)
    distance = np.where(similar & np.isfinite(distance), distance, np.inf)
    nearest = distance.argmin(axis=1)
    on = distance[np.arange(len(distance)), nearest] <= track.reach
    members: dict[int, int] = {}
    for frames in (range(middle, len(on)), range(middle - 1, -1, -1)):
        missed = 0
        for i in frames:
            missed = 0 if on[i] else missed + 1
            if missed > _MAX_GAP:
                break
            if on[i]:
                members[i] = int(nearest[i])
    return dict(sorted(members.items()))
