"""Masks of the object in videos of a fixed camera, which knows what stands behind the object.

What differs from this plate, after the exposure has been matched, is the object, its shadow, or something else that
moves: a shadow darkens all channels by one factor, and of the rest the part is taken that lies where the object is
expected. GrabCut (Rother et al. 2004) draws a first edge, on the difference from the plate in place of the colours:
there, the background is one flat colour whatever its texture. Near the floor shadows are dark and tinted, and stay in
it; once the object has been seen in flight, its colours are known, and the outline is drawn anew (`outlines`).

Pictures are RGB, uint8, (H, W, 3); masks are Boolean, (H, W); places are (x, y) [px], pixel centres at +0.5.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

from neuma_lib.capture.arcs import Arc, find_arcs
from neuma_lib.capture.masks import (
    box_of,
    centroid,
    check_background,
    check_not_empty,
    component,
    grabcut,
    grown,
    in_full,
    least_area,
    opened,
    parts_of,
    shrunk,
    whole,
)
from neuma_lib.capture.outlines import learn_palette, outline
from neuma_lib.capture.plate import compare, exposed, largest_channel, match_exposure, median_plate
from neuma_lib.errors import InputError

SURE, POSSIBLE = 30.0, 12.0
"""Differences from the plate [levels of 255] that are certainly something, and that may be where there is no noise."""
MOST_NOISE = 6.0
"""Most deviation of a camera's noise [levels], a fifth of `SURE`; what differs by more has moved."""
_OUTLINES = 2  # times that colours are learned and outlines are drawn, the second time from better masks
_LOST = 2  # frames after which an object that was not found is no longer looked for


@dataclass(frozen=True, eq=False)
class VideoMasks:
    """Masks of the frames of a video.

    Attributes:
        masks: (T, H, W), Boolean; all False where the object is not to be seen.
        moving: part of the picture, outside object and shadows, that differs from the plate, (T,).
        gains, offsets: exposure of each frame against the plate, (T, 3).
        arcs: stretches of free flight, in the order of time.
    """

    masks: np.ndarray
    moving: np.ndarray
    gains: np.ndarray
    offsets: np.ndarray
    arcs: tuple[Arc, ...]

    @property
    def centroids(self) -> np.ndarray:
        """(T, 2), NaN where the mask is empty."""
        return np.array([centroid(mask) for mask in self.masks])

    @property
    def areas(self) -> np.ndarray:
        """[px], (T,)."""
        return self.masks.sum(axis=(1, 2))


def video_masks(
    frames: Sequence[np.ndarray],
    name: str | Path,
    plate: np.ndarray | None = None,
    times: np.ndarray | None = None,
    places: np.ndarray | None = None,
    down: np.ndarray | None = None,
) -> VideoMasks:
    """Masks of the object in a video of a fixed camera.

    In free flight the object is what keeps to an arc (`find_arcs`). Before and after, it is expected where two frames
    that are nearer to the flight say, and nothing is taken that is far from there or of quite another size.

    Args:
        frames: T pictures.
        name: of the file, for messages.
        plate: the empty scene; None: the median of the frames.
        times: of the frames [s], ascending, (T,); None: evenly.
        places: where the object is expected, (T, 2), NaN where that is not known: goes before arcs.
        down: the way in which things fall in the picture, see `find_arcs`.

    Raises:
        InputError: the plate is of another size, the background moves, or the object is in no frame.
    """
    if len(frames) == 0:
        raise InputError(f"{name}: there are no frames to mask")
    if plate is None:
        plate = median_plate(frames)
    if plate.shape != frames[0].shape:
        raise InputError(
            f"{name}: the empty picture is {plate.shape[1]}x{plate.shape[0]}, the frames"
            f" {frames[0].shape[1]}x{frames[0].shape[0]}: take it as a frame of the same camera in the same mode"
        )
    seen = [_changed(frame, plate) for frame in frames]
    times = np.arange(len(frames), dtype=float) if times is None else np.asarray(times, float)
    arcs = find_arcs([change.parts[~change.cut] for change in seen], times, down)
    masks = np.zeros((len(frames), *plate.shape[:2]), bool)
    known = np.zeros(len(frames), bool)
    arcs = [_fly(arc, frames, plate, seen, times, masks, known) for arc in arcs]
    for i in [] if places is None else np.flatnonzero(~np.isnan(places).any(axis=1)):
        masks[i], known[i] = _mask(frames[i], plate, seen[i], places[i]), True
    begins = [arc.frames[0] for arc in arcs[:1]]
    for order in (
        range(begins[0] if begins else 0, len(frames)),
        range(begins[0] - 1 if begins else -1, -1, -1),
    ):
        _follow(order, frames, plate, seen, masks, known)
    drafts, masks = masks, _outlined(frames, plate, seen, masks, arcs)
    moving = np.array([(c.strong & ~grown(m, 5)).mean() for c, m in zip(seen, drafts)])
    # A hand that holds the object before its flight does no harm.
    check_background(np.where(np.arange(len(frames)) < (arcs[0].frames[0] if arcs else 0), 0, moving), name)
    check_not_empty(masks, name)
    exposures = (np.stack([getattr(change, key) for change in seen]) for key in ("gain", "offset"))
    return VideoMasks(masks, moving, *exposures, tuple(arcs))


def given_masks(masks: np.ndarray, times: np.ndarray, down: np.ndarray | None = None) -> VideoMasks:
    """Own masks (T, H, W) of a video, which are taken as they are, with the arcs that they show.

    Args:
        times: of the frames [s], ascending, (T,).
        down: the way in which things fall in the picture, see `find_arcs`.
    """
    seen = [np.array([[*centroid(mask), mask.sum()]]) if whole(mask) else np.empty((0, 3)) for mask in masks]
    still = np.ones((len(masks), 3))
    return VideoMasks(masks, np.zeros(len(masks)), still, 0 * still, tuple(find_arcs(seen, times, down)))


class _Change(NamedTuple):
    """What differs from the plate in a frame: exposure, noise, where, and its parts (x, y, area), cut off or not."""

    gain: np.ndarray
    offset: np.ndarray
    noise: float
    strong: np.ndarray
    parts: np.ndarray
    cut: np.ndarray


def _changed(frame: np.ndarray, plate: np.ndarray) -> _Change:
    gain, offset = match_exposure(frame, plate)
    difference, shadow = compare(frame, exposed(plate, gain, offset))
    largest = largest_channel(np.abs(difference))
    noise = min(1.4826 * float(np.median(largest[::4, ::4])), MOST_NOISE)
    strong = opened((largest > SURE) & ~shadow)
    labels, sizes, middles = parts_of(strong)
    enough = np.flatnonzero(sizes >= least_area(strong))
    border = np.unique(np.concatenate([labels[0], labels[-1], labels[:, 0], labels[:, -1]]))
    parts = np.column_stack([middles[enough], sizes[enough]])
    return _Change(gain, offset, noise, strong, parts, np.isin(enough + 1, border))


def _fly(
    arc: Arc,
    frames: Sequence[np.ndarray],
    plate: np.ndarray,
    seen: Sequence[_Change],
    times: np.ndarray,
    masks: np.ndarray,
    known: np.ndarray,
) -> Arc:
    """Fill in the masks along an arc, and beyond its ends as far as the object is on it: fast and blurred there, it may
    have passed for a shadow. Gives the longer arc."""

    def flying(i: int) -> np.ndarray:
        return _mask(frames[i], plate, seen[i], arc.place(times[i]), arc.area, 2 * arc.reach, in_flight=True)

    first, last = arc.frames
    for i in range(first, last + 1):
        masks[i] = flying(i)
        known[i] = masks[i].any()
    while first > 0 and not known[first - 1] and whole(mask := flying(first - 1)):
        first -= 1
        masks[first], known[first] = mask, True
    while last + 1 < len(frames) and not known[last + 1] and whole(mask := flying(last + 1)):
        last += 1
        masks[last], known[last] = mask, True
    return replace(arc, frames=(first, last))


def _follow(
    order: range,
    frames: Sequence[np.ndarray],
    plate: np.ndarray,
    seen: Sequence[_Change],
    masks: np.ndarray,
    known: np.ndarray,
) -> None:
    """Fill in masks one after the other, each from the two before it."""
    last: list[tuple[int, np.ndarray, float]] = []
    if order.step < 0:  # begin with what is known behind the first
        after = [i for i in range(order.start + 1, len(frames)) if masks[i].any()][:2]
        last = [(i, centroid(masks[i]), float(masks[i].sum())) for i in reversed(after)]
        if not last:
            return
    for i in order:
        if not known[i]:
            if not last:
                masks[i] = _mask(frames[i], plate, seen[i])
            elif abs(i - last[-1][0]) <= _LOST:
                (_, place, area), step = last[-1], np.zeros(2)
                if len(last) > 1:
                    step = (place - last[-2][1]) / abs(last[-1][0] - last[-2][0]) * abs(i - last[-1][0])
                # It may have been stopped, or have turned back.
                gate = 1.5 * np.sqrt(area / np.pi) + 1.5 * np.linalg.norm(step)
                masks[i] = _mask(frames[i], plate, seen[i], place + step, area, gate)
        if masks[i].any():
            last = [*last[-1:], (i, centroid(masks[i]), float(masks[i].sum()))]


def _outlined(
    frames: Sequence[np.ndarray],
    plate: np.ndarray,
    seen: Sequence[_Change],
    masks: np.ndarray,
    arcs: Sequence[Arc],
) -> np.ndarray:
    """Masks whose outlines are drawn with the colours that the object shows in its first flight; without one, as they
    are."""
    if not arcs:
        return masks
    first, last = arcs[0].frames
    flying = slice(first, last + 1)
    plates = [exposed(plate, change.gain, change.offset) for change in seen]
    for _ in range(_OUTLINES):
        palette = learn_palette(frames[flying], plates[flying], masks[flying])
        if palette is None:
            break
        masks = masks.copy()
        for i in np.flatnonzero(masks.any(axis=(1, 2))):
            found = outline(frames[i], plates[i], masks[i], palette)
            if found.any():
                masks[i] = found
    return masks


def _mask(
    frame: np.ndarray,
    plate: np.ndarray,
    change: _Change,
    place: np.ndarray | None = None,
    area: float | None = None,
    gate: float | None = None,
    in_flight: bool = False,
) -> np.ndarray:
    """The mask of a frame near a place, refined; empty where there is none."""
    mask = component(change.strong, place, area, gate)
    empty = exposed(plate, change.gain, change.offset)
    if in_flight and not mask.any() and not component(change.strong, place, area, 2 * gate).any():
        # Nothing but the object is here: blurred and dark, it only looks like a shadow.
        largest = largest_channel(np.abs(frame - empty))
        mask = component(opened(largest > SURE), place, area, gate)
    if not mask.any():
        return mask
    radius = np.sqrt(mask.sum() / np.pi)
    box = box_of(mask, 2 * max(3, round(0.3 * radius)))
    difference, shadow = compare(frame[box], empty[box])
    return in_full(_refined(difference, shadow, mask[box], max(POSSIBLE, 3 * change.noise)), box, mask.shape)


def _refined(difference: np.ndarray, shadow: np.ndarray, mask: np.ndarray, possible: float) -> np.ndarray:
    """The mask with its edge drawn by GrabCut on the difference from the plate."""
    radius = np.sqrt(mask.sum() / np.pi)
    inner, outer = max(1, round(0.15 * radius)), max(3, round(0.3 * radius))
    difference = np.where((shadow & ~mask)[..., None], 0, difference)
    strength = largest_channel(np.abs(difference))
    reach, sure = grown(mask, outer), shrunk(mask, inner)
    foreground = (strength > SURE) & reach
    background = ~reach | ((strength < possible) & ~mask)
    image = np.clip(128 + difference / 2, 0, 255).astype(np.uint8)
    return grabcut(image, sure, foreground, background)
