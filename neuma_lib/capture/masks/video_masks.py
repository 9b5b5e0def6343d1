"""Masks of the object in videos of a fixed camera with a known background.

After matching the exposure, the object, its shadow and other moving objects differ from the background. Shadows darken
all channels by one factor. Of the rest, the component at the expected position of the object is selected. GrabCut
(Rother et al. 2004) draws a first edge on the difference image, in which the background is flat whatever its texture.
Dark, tinted shadows near the floor remain in this mask. They are removed with the colours of the object, learned in
free flight (`silhouettes`).

A long video is first read once at reduced size to find the flight (`find_flight_window`). Only the frames near it are
masked. Pictures may lie in a file (`neuma_lib.capture.frames.StoredPictures`): one at a time is in memory.

Pictures are RGB, uint8, (H, W, 3). Masks are Boolean, (H, W). Positions are (x, y) [px], pixel centres at +0.5.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from neuma_lib.capture.masks.background import (
    compare,
    exposed,
    largest_channel,
    match_exposure,
    median_background,
)
from neuma_lib.capture.masks.continuity import Break, appearance, broken_frames, grouped
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
    radius_of,
    shrunk,
    whole,
)
from neuma_lib.capture.masks.silhouettes import learn_palette, silhouette
from neuma_lib.capture.motion.ballistic_tracks import BallisticTrack, find_ballistic_tracks
from neuma_lib.errors import InputError

_SURE = 30.0  # difference from the background that is certainly an object [levels of 255]
_POSSIBLE = 12.0  # difference that may be an object in a picture without noise [levels of 255]
_MAX_NOISE = 6.0  # maximum standard deviation of a camera's noise [levels]; larger differences are motion
_ROUNDS = 2  # iterations of learning colours and drawing silhouettes
MAX_FRAMES = 300
"""Number of frames of a video that are masked. More are thinned out."""
_BEFORE = 0.1  # time before the flight that is masked as well [s]
_LOST = 2  # frames after which a lost object is no longer searched for


@dataclass(frozen=True, eq=False)
class VideoMasks:
    """Masks of the frames of a video.

    Attributes:
        masks: (T, H, W), Boolean, all False where the object is not visible.
        moving: share of the picture outside object and shadows that differs from the background, (T,).
        tracks: segments of free flight, in order of time.
        breaks: frames that were left out since their masks do not continue the track.
    """

    masks: np.ndarray
    moving: np.ndarray
    tracks: tuple[BallisticTrack, ...]
    breaks: tuple[Break, ...] = ()

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

    In free flight the object moves along a parabola (`find_ballistic_tracks`). Before and after, its position is
    extrapolated from the two frames closer to the flight, and components far from it or of a very different size are
    ignored.

    Args:
        frames: T pictures.
        name: of the file for messages.
        background: the empty scene. None: the median of the frames.
        times: of the frames [s], ascending, (T,). None: evenly spaced.
        places: expected positions of the object, (T, 2), NaN if unknown. They take precedence over tracks.
        down: direction of gravity in the picture, see `find_ballistic_tracks`.

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
    changes = [_Change(frames, i, background) for i in range(len(frames))]
    times = np.arange(len(frames), dtype=float) if times is None else np.asarray(times, float)
    tracks = find_ballistic_tracks([change.parts[~change.cut] for change in changes], times, down)
    drafts = _Drafts(changes)
    tracks = [drafts.follow_track(track, times) for track in tracks]
    for i in [] if places is None else np.flatnonzero(~np.isnan(places).any(axis=1)):
        drafts.masks[i], drafts.known[i] = changes[i].mask(places[i]), True
    begin = tracks[0].frames[0] if tracks else 0
    for order in (range(begin, len(frames)), range(begin - 1, -1, -1)):
        drafts.extrapolate(order)
    masks = drafts.masks
    moving = np.array([(c.strong & ~grown(m, 5)).mean() for c, m in zip(changes, masks)])
    _draw_silhouettes(changes, masks, tracks)
    # A hand that holds the object before its flight is allowed.
    check_background(np.where(np.arange(len(frames)) < begin, 0, moving), name)
    masks[masks.sum(axis=(1, 2)) < min_area(masks[0])] = False
    breaks = []
    if tracks and places is None:
        seen = [appearance(change.frame, mask) for change, mask in zip(changes, masks)]
        broken = broken_frames(seen, times, tracks[0].frames)
        masks[[i for i, _ in broken]] = False
        breaks = grouped(broken)
    check_not_empty(masks, name)
    return VideoMasks(masks, moving, tuple(tracks), tuple(breaks))


def find_flight_window(
    pictures: Iterable[np.ndarray],
    background: np.ndarray,
    times: np.ndarray,
    duration: float,
    down: np.ndarray | None = None,
) -> np.ndarray:
    """Indices of the frames from shortly before the first free flight on, at most `MAX_FRAMES`.

    Only the list of moving regions of each frame stays in memory. Without a flight, the window begins with the first
    motion.

    Args:
        pictures: of T frames, possibly at reduced size.
        background: the empty scene at that size.
        times: of the frames [s], ascending, (T,).
        duration: from the start of the flight [s].
        down: see `find_ballistic_tracks`.
    """
    parts = []
    for picture in pictures:
        change = _Change([picture], 0, background)
        parts.append(change.parts[~change.cut])
    tracks = find_ballistic_tracks(parts, times, down)
    moving = [i for i, each in enumerate(parts) if len(each)]
    start = times[tracks[0].frames[0] if tracks else moving[0] if moving else 0]
    window = np.flatnonzero((times >= start - _BEFORE) & (times <= start + duration))
    return window[:: -(-len(window) // MAX_FRAMES)]


def given_masks(masks: np.ndarray, times: np.ndarray, down: np.ndarray | None = None) -> VideoMasks:
    """Masks (T, H, W) of the user at ascending times (T,) [s], with tracks by `find_ballistic_tracks`."""
    parts = [np.array([[*centroid(mask), mask.sum()]]) if whole(mask) else np.empty((0, 3)) for mask in masks]
    return VideoMasks(masks, np.zeros(len(masks)), tuple(find_ballistic_tracks(parts, times, down)))


class _Change:
    """Difference of a frame from the background. Pictures are computed again when they are used.

    Attributes:
        noise: standard deviation of the camera's noise [levels].
        parts: components (x, y, area) of the pixels that certainly differ, (N, 3).
        cut: which components touch the border, (N,).
    """

    def __init__(self, frames: Sequence[np.ndarray], number: int, background: np.ndarray):
        self._frames, self._number, self._background = frames, number, background
        frame = self.frame
        self._exposure = match_exposure(frame, background)
        difference, shadow = compare(frame, self.empty)
        largest = largest_channel(np.abs(difference))
        self.noise = min(1.4826 * float(np.median(largest[::4, ::4])), _MAX_NOISE)
        strong = opened((largest > _SURE) & ~shadow)
        self._strong = np.packbits(strong)
        labels, sizes, middles = parts_of(strong)
        enough = np.flatnonzero(sizes >= min_area(strong))
        border = np.unique(np.concatenate([labels[0], labels[-1], labels[:, 0], labels[:, -1]]))
        self.parts = np.column_stack([middles[enough], sizes[enough]])
        self.cut = np.isin(enough + 1, border)

    @property
    def frame(self) -> np.ndarray:
        """The frame, (H, W, 3)."""
        return self._frames[self._number]

    @property
    def empty(self) -> np.ndarray:
        """The background at the exposure of the frame, (H, W, 3)."""
        return exposed(self._background, *self._exposure)

    @property
    def strong(self) -> np.ndarray:
        """Pixels that certainly differ, (H, W)."""
        shape = self._background.shape[:2]
        return np.unpackbits(self._strong, count=shape[0] * shape[1]).reshape(shape).view(bool)

    def mask(
        self,
        place: np.ndarray | None = None,
        area: float | None = None,
        gate: float | None = None,
        in_flight: bool = False,
    ) -> np.ndarray:
        """The refined mask near a position, see `component`. Empty if there is no component."""
        strong, frame, empty = self.strong, self.frame, self.empty
        mask = component(strong, place, area, gate)
        if in_flight and not mask.any() and not component(strong, place, area, 2 * gate).any():
            # Only the object can be here. Blurred and dark, it was taken for a shadow.
            largest = largest_channel(np.abs(frame - empty))
            mask = component(opened(largest > _SURE), place, area, gate)
        if not mask.any():
            return mask
        box = box_of(mask, 2 * max(3, round(0.3 * radius_of(mask))))
        difference, shadow = compare(frame[box], empty[box])
        refined = _refined(difference, shadow, mask[box], max(_POSSIBLE, 3 * self.noise))
        return in_full(refined, box, mask.shape)


class _Drafts:
    """Masks (T, H, W) of a video, and which of them are known, (T,)."""

    def __init__(self, changes: Sequence[_Change]):
        self.changes = changes
        self.masks = np.zeros((len(changes), *changes[0].strong.shape), bool)
        self.known = np.zeros(len(changes), bool)

    def follow_track(self, track: BallisticTrack, times: np.ndarray) -> BallisticTrack:
        """Fill in the masks along a track and return the track.

        It is extended while the object is on it, since a fast, blurred object may have been taken for a shadow.
        """

        def flying(i: int) -> np.ndarray:
            place = track.place(times[i])
            return self.changes[i].mask(place, track.area, 2 * track.reach, in_flight=True)

        first, last = track.frames
        for i in range(first, last + 1):
            self.masks[i] = flying(i)
            self.known[i] = self.masks[i].any()
        while first > 0 and not self.known[first - 1] and whole(mask := flying(first - 1)):
            first -= 1
            self.masks[first], self.known[first] = mask, True
        while last + 1 < len(times) and not self.known[last + 1] and whole(mask := flying(last + 1)):
            last += 1
            self.masks[last], self.known[last] = mask, True
        return replace(track, frames=(first, last))

    def extrapolate(self, order: range) -> None:
        """Fill in unknown masks one after the other, each from the two previous ones."""
        last: list[tuple[int, np.ndarray, float]] = []
        if order.step < 0:  # start from the masks that follow
            after = [i for i in range(order.start + 1, len(self.masks)) if self.masks[i].any()][:2]
            last = [self._seen(i) for i in reversed(after)]
            if not last:
                return
        for i in order:
            if not self.known[i]:
                if not last:
                    self.masks[i] = self.changes[i].mask()
                elif abs(i - last[-1][0]) <= _LOST:
                    (_, place, area), step = last[-1], np.zeros(2)
                    if len(last) > 1:
                        step = (place - last[-2][1]) / abs(last[-1][0] - last[-2][0]) * abs(i - last[-1][0])
                    # The object may have stopped or reversed.
                    gate = 1.5 * np.sqrt(area / np.pi) + 1.5 * np.linalg.norm(step)
                    self.masks[i] = self.changes[i].mask(place + step, area, gate)
            if self.masks[i].any():
                last = [*last[-1:], self._seen(i)]

    def _seen(self, i: int) -> tuple[int, np.ndarray, float]:
        return i, centroid(self.masks[i]), float(self.masks[i].sum())


def _draw_silhouettes(
    changes: Sequence[_Change], masks: np.ndarray, tracks: Sequence[BallisticTrack]
) -> None:
    """Refine masks (T, H, W) in place with the colours of the object in its first flight."""
    flying = range(tracks[0].frames[0], tracks[0].frames[1] + 1) if tracks else ()
    for _ in range(_ROUNDS):
        palette = learn_palette((changes[i].frame, changes[i].empty, masks[i]) for i in flying)
        if palette is None:
            break
        for i in np.flatnonzero(masks.any(axis=(1, 2))):
            refined = silhouette(changes[i].frame, changes[i].empty, masks[i], palette)
            if refined.any():
                masks[i] = refined


def _refined(difference: np.ndarray, shadow: np.ndarray, mask: np.ndarray, possible: float) -> np.ndarray:
    """The mask with its edge refined by GrabCut on the difference from the background."""
    radius = radius_of(mask)
    inner, outer = max(1, round(0.15 * radius)), max(3, round(0.3 * radius))
    difference = np.where((shadow & ~mask)[..., None], 0, difference)
    strength = largest_channel(np.abs(difference))
    reach, sure = grown(mask, outer), shrunk(mask, inner)
    foreground = (strength > _SURE) & reach
    background = ~reach | ((strength < possible) & ~mask)
    image = np.clip(128 + difference / 2, 0, 255).astype(np.uint8)
    return grabcut(image, sure, foreground, background)
