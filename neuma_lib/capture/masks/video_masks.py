"""Masks of the object in videos of a fixed camera with a known background.

After matching the exposure, the object, its shadow and other moving things differ from the background. Shadows darken
all channels by one factor. Of the rest, the component at the expected position of the object is selected. GrabCut
(Rother et al. 2004) draws a first edge on the difference image, in which the background is flat whatever its texture.
Dark, tinted shadows near the floor remain in this mask. They are removed with the colours of the object, learned in
free flight (`outlines`).

Pictures are RGB, uint8, (H, W, 3). Masks are Boolean, (H, W). Positions are (x, y) [px], pixel centres at +0.5.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

from neuma_lib.capture.masks.background import (
    compare,
    exposed,
    largest_channel,
    match_exposure,
    median_background,
)
from neuma_lib.capture.masks.regions import (
    box_of,
    centroid,
    check_background,
    check_not_empty,
    component,
    grabcut,
    grown,
    in_full,
    min_area,
    opened,
    parts_of,
    shrunk,
    whole,
)
from neuma_lib.capture.masks.silhouettes import learn_palette, outline
from neuma_lib.capture.motion.ballistic_tracks import Arc, find_arcs
from neuma_lib.errors import InputError

SURE, POSSIBLE = 30.0, 12.0
"""Differences from the background that are certainly, and possibly without noise, an object [levels of 255]."""
MAX_NOISE = 6.0
"""Maximum standard deviation of a camera's noise [levels]. Larger differences are motion."""
_OUTLINES = 2  # iterations of learning colours and drawing outlines
_LOST = 2  # frames after which a lost object is no longer searched for


@dataclass(frozen=True, eq=False)
class VideoMasks:
    """Masks of the frames of a video.

    Attributes:
        masks: (T, H, W), Boolean, all False where the object is not visible.
        moving: share of the picture outside object and shadows that differs from the background, (T,).
        gains, offsets: exposure of each frame relative to the background, (T, 3).
        arcs: segments of free flight, in order of time.
    """

    masks: np.ndarray
    moving: np.ndarray
    gains: np.ndarray
    offsets: np.ndarray
    arcs: tuple[Arc, ...]

    @property
    def centroids(self) -> np.ndarray:
        """(T, 2) [px], NaN where the mask is empty."""
        return np.array([centroid(mask) for mask in self.masks])

    @property
    def areas(self) -> np.ndarray:
        """[px], (T,)."""
        return self.masks.sum(axis=(1, 2))


def video_masks(
    frames: Sequence[np.ndarray],
    name: str | Path,
    background: np.ndarray | None = None,
    times: np.ndarray | None = None,
    places: np.ndarray | None = None,
    down: np.ndarray | None = None,
) -> VideoMasks:
    """Masks of the object in a video of a fixed camera.

    In free flight the object moves along an arc (`find_arcs`). Before and after, its position is extrapolated from the
    two frames closer to the flight, and components far from it or of a very different size are ignored.

    Args:
        frames: T pictures.
        name: of the file for messages.
        background: the empty scene. None: the median of the frames.
        times: of the frames [s], ascending, (T,). None: evenly spaced.
        places: expected positions of the object, (T, 2), NaN if unknown. They take precedence over arcs.
        down: direction of gravity in the picture, see `find_arcs`.

    Raises:
        InputError: no frames, a background of another size or that moves, or the object is in no frame.
    """
    if len(frames) == 0:
        raise InputError(name, "there are no frames to mask")
    if background is None:
        background = median_background(frames)
    if background.shape != frames[0].shape:
        raise InputError(
            name,
            f"the empty picture is {background.shape[1]}x{background.shape[0]}, the frames"
            f" {frames[0].shape[1]}x{frames[0].shape[0]}",
            "Use a frame of the same camera in the same mode as the empty picture",
        )
    seen = [_changed(frame, background) for frame in frames]
    times = np.arange(len(frames), dtype=float) if times is None else np.asarray(times, float)
    arcs = find_arcs([change.parts[~change.cut] for change in seen], times, down)
    masks = np.zeros((len(frames), *background.shape[:2]), bool)
    known = np.zeros(len(frames), bool)
    arcs = [_mask_arc(arc, frames, background, seen, times, masks, known) for arc in arcs]
    for i in [] if places is None else np.flatnonzero(~np.isnan(places).any(axis=1)):
        masks[i], known[i] = _mask(frames[i], background, seen[i], places[i]), True
    begin = arcs[0].frames[0] if arcs else 0
    for order in (range(begin, len(frames)), range(begin - 1, -1, -1)):
        _follow(order, frames, background, seen, masks, known)
    drafts, masks = masks, _outlined(frames, background, seen, masks, arcs)
    moving = np.array([(c.strong & ~grown(m, 5)).mean() for c, m in zip(seen, drafts)])
    # A hand that holds the object before its flight is allowed.
    check_background(np.where(np.arange(len(frames)) < begin, 0, moving), name)
    check_not_empty(masks, name)
    exposures = (np.stack([getattr(change, key) for change in seen]) for key in ("gain", "offset"))
    return VideoMasks(masks, moving, *exposures, tuple(arcs))


def given_masks(masks: np.ndarray, times: np.ndarray, down: np.ndarray | None = None) -> VideoMasks:
    """Masks (T, H, W) of the user at ascending times (T,) [s], with arcs detected by `find_arcs`."""
    seen = [np.array([[*centroid(mask), mask.sum()]]) if whole(mask) else np.empty((0, 3)) for mask in masks]
    still = np.ones((len(masks), 3))
    return VideoMasks(masks, np.zeros(len(masks)), still, 0 * still, tuple(find_arcs(seen, times, down)))


class _Change(NamedTuple):
    """Difference of a frame from the background.

    Exposure, noise, mask, components (x, y, area), and which of these touch the border.
    """

    gain: np.ndarray
    offset: np.ndarray
    noise: float
    strong: np.ndarray
    parts: np.ndarray
    cut: np.ndarray


def _changed(frame: np.ndarray, background: np.ndarray) -> _Change:
    gain, offset = match_exposure(frame, background)
    difference, shadow = compare(frame, exposed(background, gain, offset))
    largest = largest_channel(np.abs(difference))
    noise = min(1.4826 * float(np.median(largest[::4, ::4])), MAX_NOISE)
    strong = opened((largest > SURE) & ~shadow)
    labels, sizes, middles = parts_of(strong)
    enough = np.flatnonzero(sizes >= min_area(strong))
    border = np.unique(np.concatenate([labels[0], labels[-1], labels[:, 0], labels[:, -1]]))
    parts = np.column_stack([middles[enough], sizes[enough]])
    return _Change(gain, offset, noise, strong, parts, np.isin(enough + 1, border))


def _mask_arc(
    arc: Arc,
    frames: Sequence[np.ndarray],
    background: np.ndarray,
    seen: Sequence[_Change],
    times: np.ndarray,
    masks: np.ndarray,
    known: np.ndarray,
) -> Arc:
    """Fill in the masks along an arc and return the arc.

    It is extended while the object is on it, since a fast, blurred object may have been taken for a shadow.
    """

    def flying(i: int) -> np.ndarray:
        return _mask(
            frames[i], background, seen[i], arc.place(times[i]), arc.area, 2 * arc.reach, in_flight=True
        )

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
    background: np.ndarray,
    seen: Sequence[_Change],
    masks: np.ndarray,
    known: np.ndarray,
) -> None:
    """Fill in masks one after the other, each from the two previous ones."""
    last: list[tuple[int, np.ndarray, float]] = []
    if order.step < 0:  # start from the masks that follow
        after = [i for i in range(order.start + 1, len(frames)) if masks[i].any()][:2]
        last = [(i, centroid(masks[i]), float(masks[i].sum())) for i in reversed(after)]
        if not last:
            return
    for i in order:
        if not known[i]:
            if not last:
                masks[i] = _mask(frames[i], background, seen[i])
            elif abs(i - last[-1][0]) <= _LOST:
                (_, place, area), step = last[-1], np.zeros(2)
                if len(last) > 1:
                    step = (place - last[-2][1]) / abs(last[-1][0] - last[-2][0]) * abs(i - last[-1][0])
                # The object may have stopped or reversed.
                gate = 1.5 * np.sqrt(area / np.pi) + 1.5 * np.linalg.norm(step)
                masks[i] = _mask(frames[i], background, seen[i], place + step, area, gate)
        if masks[i].any():
            last = [*last[-1:], (i, centroid(masks[i]), float(masks[i].sum()))]


def _outlined(
    frames: Sequence[np.ndarray],
    background: np.ndarray,
    seen: Sequence[_Change],
    masks: np.ndarray,
    arcs: Sequence[Arc],
) -> np.ndarray:
    """Masks with outlines from the colours of the object in its first flight. Unchanged without a flight."""
    if not arcs:
        return masks
    first, last = arcs[0].frames
    flying = slice(first, last + 1)
    backgrounds = [exposed(background, change.gain, change.offset) for change in seen]
    for _ in range(_OUTLINES):
        palette = learn_palette(frames[flying], backgrounds[flying], masks[flying])
        if palette is None:
            break
        masks = masks.copy()
        for i in np.flatnonzero(masks.any(axis=(1, 2))):
            outlined = outline(frames[i], backgrounds[i], masks[i], palette)
            if outlined.any():
                masks[i] = outlined
    return masks


def _mask(
    frame: np.ndarray,
    background: np.ndarray,
    change: _Change,
    place: np.ndarray | None = None,
    area: float | None = None,
    gate: float | None = None,
    in_flight: bool = False,
) -> np.ndarray:
    """The refined mask of a frame near a position. Empty if there is no component."""
    mask = component(change.strong, place, area, gate)
    empty = exposed(background, change.gain, change.offset)
    if in_flight and not mask.any() and not component(change.strong, place, area, 2 * gate).any():
        # Only the object can be here. Blurred and dark, it was taken for a shadow.
        largest = largest_channel(np.abs(frame - empty))
        mask = component(opened(largest > SURE), place, area, gate)
    if not mask.any():
        return mask
    radius = np.sqrt(mask.sum() / np.pi)
    box = box_of(mask, 2 * max(3, round(0.3 * radius)))
    difference, shadow = compare(frame[box], empty[box])
    return in_full(_refined(difference, shadow, mask[box], max(POSSIBLE, 3 * change.noise)), box, mask.shape)


def _refined(difference: np.ndarray, shadow: np.ndarray, mask: np.ndarray, possible: float) -> np.ndarray:
    """The mask with its edge refined by GrabCut on the difference from the background."""
    radius = np.sqrt(mask.sum() / np.pi)
    inner, outer = max(1, round(0.15 * radius)), max(3, round(0.3 * radius))
    difference = np.where((shadow & ~mask)[..., None], 0, difference)
    strength = largest_channel(np.abs(difference))
    reach, sure = grown(mask, outer), shrunk(mask, inner)
    foreground = (strength > SURE) & reach
    background = ~reach | ((strength < possible) & ~mask)
    image = np.clip(128 + difference / 2, 0, 255).astype(np.uint8)
    return grabcut(image, sure, foreground, background)
