"""Masks of the object: in videos of a fixed camera against the empty scene, in photographs by a network.

A fixed camera knows what stands behind the object. What differs from this plate, after the exposure has been matched,
is the object, its shadow, or something else that moves: a shadow darkens all channels by one factor, and of the rest
the part is taken that lies where the object is expected. GrabCut (Rother et al. 2004) then draws the edge, on the
difference from the plate in place of the colours: there, the background is one flat colour whatever its texture.

Pictures are RGB, uint8, (H, W, 3); masks are Boolean, (H, W); places are (x, y) [px], pixel centres at +0.5.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy import ndimage

from neuma_lib.capture.arcs import Arc, find_arcs
from neuma_lib.capture.frames import Frame
from neuma_lib.capture.tools import opencv
from neuma_lib.errors import InputError
from neuma_lib.io.files import existing, reading
from neuma_lib.io.images import open_image

MOST_PLATE_FRAMES = 61
"""Frames of which the median is taken where there is no empty still."""
SURE, POSSIBLE = 30.0, 12.0
"""Differences from the plate [levels of 255] that are certainly something, and that may be where there is no noise."""
SHADOW = (0.4, 0.97)
"""Factors by which a shadow darkens."""
SHADOW_TINT = 0.06
"""Most difference between the factors of the channels in a shadow."""
LEAST_AREA = 2e-5
"""Part of the picture that an object covers at least."""
MOST_MOVING = 0.1
"""Part of the picture outside object and shadows that may differ from the plate."""
MOST_JUMP = 1.0
"""Change of a mask's area from one frame of free flight to the next that is an error: something else has come in. In
sharp pictures 0.03 is usual; blur and a ground of a like colour make it 0.3."""
MOST_NOISE = 6.0
"""Most deviation of a camera's noise [levels], a fifth of `SURE`; what differs by more has moved."""
EDGE = 0.7
"""Deviation of the blur that makes a mask's edge soft [px]."""
_RATIO = 3.0  # of areas from frame to frame that may be the same object's
_LOST = 2  # frames after which an object that was not found is no longer looked for
_GRABCUT_ROUNDS = 4
_LONGEST = 800  # side of a photograph that GrabCut works on [px]
_AROUND = 1.3  # size of the floor around a board, in boards
_NEUTRAL = (12.0, 0.12)  # range of the channels of a neutral pixel: levels, and part of the largest


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


def centroid(mask: np.ndarray) -> np.ndarray:
    """Mean place (x, y) of a mask, (2,); NaN where it is empty."""
    y, x = np.nonzero(mask)
    return np.array([x.mean(), y.mean()]) + 0.5 if len(x) else np.full(2, np.nan)


def median_plate(frames: Sequence[np.ndarray]) -> np.ndarray:
    """The empty scene as the median of frames (H, W, 3), uint8: right where the object is in less than half of them."""
    chosen = np.linspace(0, len(frames) - 1, min(len(frames), MOST_PLATE_FRAMES)).round().astype(int)
    return np.median(np.stack([frames[i] for i in chosen]), axis=0).round().astype(np.uint8)


def match_exposure(frame: np.ndarray, plate: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Gain and offset of each channel, (3,) each, so that frame = gain * plate + offset where nothing has moved.

    Least squares, repeated without the pixels whose residual is large: what moves covers less than half of the picture.
    """
    gains, offsets = np.ones(3), np.zeros(3)
    step = max(1, int(np.sqrt(frame[..., 0].size / 5e4)))  # two unknowns do not need every pixel
    for c in range(3):
        seen, empty = (p[::step, ::step, c].ravel().astype(np.float64) for p in (frame, plate))
        valid = (seen > 4) & (seen < 251) & (empty > 4) & (empty < 251)  # clipped ones do not follow
        if valid.sum() < 100:
            continue
        seen, empty = seen[valid], empty[valid]
        ratio = np.median(seen / empty)
        kept = np.abs(seen - ratio * empty) <= np.quantile(np.abs(seen - ratio * empty), 0.6)
        for _ in range(8):
            x, y = empty[kept], seen[kept]
            # A plate of one brightness tells no offset from a gain.
            gain = np.cov(x, y)[0, 1] / x.var(ddof=1) if x.std() > 4 else y.mean() / x.mean()
            offset = y.mean() - gain * x.mean()
            residual = np.abs(seen - gain * empty - offset)
            kept = residual <= max(2.0, 3 * 1.4826 * np.median(residual))
        gains[c], offsets[c] = gain, offset
    return gains, offsets


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
    moving = np.array([(c.strong & ~_grown(m, 5)).mean() for c, m in zip(seen, masks)])
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
    seen = [np.array([[*centroid(mask), mask.sum()]]) if _whole(mask) else np.empty((0, 3)) for mask in masks]
    still = np.ones((len(masks), 3))
    return VideoMasks(masks, np.zeros(len(masks)), still, 0 * still, tuple(find_arcs(seen, times, down)))


def _whole(mask: np.ndarray) -> bool:
    """Whether there is something, and the picture's border does not cut it."""
    return bool(mask.any() and not _cut(mask))


def _cut(mask: np.ndarray) -> bool:
    return bool(mask[[0, -1]].any() or mask[:, [0, -1]].any())


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
    difference, shadow = compare(frame, _exposed(plate, gain, offset))
    largest = _largest(np.abs(difference))
    noise = min(1.4826 * float(np.median(largest[::4, ::4])), MOST_NOISE)
    strong = _opened((largest > SURE) & ~shadow)
    labels, sizes, middles = _parts(strong)
    enough = np.flatnonzero(sizes >= _least_area(strong))
    border = np.unique(np.concatenate([labels[0], labels[-1], labels[:, 0], labels[:, -1]]))
    parts = np.column_stack([middles[enough], sizes[enough]])
    return _Change(gain, offset, noise, strong, parts, np.isin(enough + 1, border))


def _parts(mask: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Labels (H, W) of the connected parts, from 1, their areas (N,) [px] and their middles (N, 2)."""
    _, labels, stats, middles = opencv().connectedComponentsWithStats(mask.view(np.uint8))
    return labels, stats[1:, -1].astype(float), middles[1:] + 0.5


def _largest(picture: np.ndarray) -> np.ndarray:
    """Largest of the three channels, (H, W); numpy's own maximum along so short an axis takes ten times as long."""
    return np.maximum(np.maximum(picture[..., 0], picture[..., 1]), picture[..., 2])


def _opened(mask: np.ndarray) -> np.ndarray:
    cv2 = opencv()
    return cv2.morphologyEx(mask.view(np.uint8), cv2.MORPH_OPEN, _cross()).view(bool)


def _cross() -> np.ndarray:
    cv2 = opencv()
    return cv2.getStructuringElement(cv2.MORPH_CROSS, (3, 3))


def _grown(mask: np.ndarray, by: int) -> np.ndarray:
    return opencv().dilate(mask.view(np.uint8), _cross(), iterations=by).view(bool)


def _shrunk(mask: np.ndarray, by: int) -> np.ndarray:
    """What is farther than some pixels from an edge; the picture's border is one."""
    return opencv().erode(mask.view(np.uint8), _cross(), iterations=by, borderValue=0).view(bool)


def _exposed(plate: np.ndarray, gain: np.ndarray, offset: np.ndarray) -> np.ndarray:
    return plate * gain.astype(np.float32) + offset.astype(np.float32)


def _least_area(picture: np.ndarray) -> float:
    return max(9, LEAST_AREA * picture.size)


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
    while first > 0 and not known[first - 1] and _whole(mask := flying(first - 1)):
        first -= 1
        masks[first], known[first] = mask, True
    while last + 1 < len(frames) and not known[last + 1] and _whole(mask := flying(last + 1)):
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
    mask = _component(change.strong, place, area, gate)
    empty = _exposed(plate, change.gain, change.offset)
    if in_flight and not mask.any() and not _component(change.strong, place, area, 2 * gate).any():
        # Nothing but the object is here: blurred and dark, it only looks like a shadow.
        largest = _largest(np.abs(frame - empty))
        mask = _component(_opened(largest > SURE), place, area, gate)
    if not mask.any():
        return mask
    radius = np.sqrt(mask.sum() / np.pi)
    box = _box(mask, 2 * max(3, round(0.3 * radius)))
    difference, shadow = compare(frame[box], empty[box])
    return _in_full(_refined(difference, shadow, mask[box], max(POSSIBLE, 3 * change.noise)), box, mask.shape)


def compare(frame: np.ndarray, expected: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Difference of a frame from the plate at its exposure, (H, W, 3), float32, and where it is a shadow, (H, W).

    A shadow darkens every channel by nearly the same factor. The factors are those of medians over 5 x 5 pixels, which
    noise changes little, and which keep the edge between an object and its shadow.
    """
    cv2 = opencv()
    pictures = [np.maximum(picture.astype(np.float32), 0) for picture in (frame, expected)]
    seen, empty = (cv2.medianBlur(picture, 5) for picture in pictures)
    factor = seen / np.maximum(empty, 1.0)
    spread = _largest(factor) + _largest(-factor)
    mean = (factor[..., 0] + factor[..., 1] + factor[..., 2]) / 3
    return pictures[0] - expected, (mean > SHADOW[0]) & (mean < SHADOW[1]) & (spread < SHADOW_TINT)


def _component(
    strong: np.ndarray, place: np.ndarray | None = None, area: float | None = None, gate: float | None = None
) -> np.ndarray:
    """The connected part that is nearest to a place and to an area; the largest where neither is known.

    With a gate [px], a part whose middle is farther from the place, or whose area is another by more than `_RATIO`, is
    not taken.
    """
    labels, sizes, middles = _parts(strong)
    enough = np.flatnonzero(sizes >= _least_area(strong))
    if len(enough) == 0:
        return np.zeros_like(strong)
    score = np.log(sizes[enough])
    if area is not None:
        score = -np.abs(score - np.log(area))
    if place is not None:
        reach = np.sqrt((sizes[enough] if area is None else area) / np.pi)
        off = np.linalg.norm(middles[enough] - place, axis=1)
        score = score - (off / (2 * reach)) ** 2
        if gate is not None:
            score[(off > gate) | (np.abs(np.log(sizes[enough] / area)) > np.log(_RATIO))] = -np.inf
    if not np.isfinite(score).any():
        return np.zeros_like(strong)
    return ndimage.binary_fill_holes(labels == enough[np.argmax(score)] + 1)


def _refined(difference: np.ndarray, shadow: np.ndarray, mask: np.ndarray, possible: float) -> np.ndarray:
    """The mask with its edge drawn by GrabCut on the difference from the plate."""
    radius = np.sqrt(mask.sum() / np.pi)
    inner, outer = max(1, round(0.15 * radius)), max(3, round(0.3 * radius))
    difference = np.where((shadow & ~mask)[..., None], 0, difference)
    strength = _largest(np.abs(difference))
    reach, sure = _grown(mask, outer), _shrunk(mask, inner)
    foreground = (strength > SURE) & reach
    background = ~reach | ((strength < possible) & ~mask)
    image = np.clip(128 + difference / 2, 0, 255).astype(np.uint8)
    return _grabcut(image, sure, foreground, background)


def _box(mask: np.ndarray, margin: int) -> tuple[slice, slice]:
    rows, columns = (np.flatnonzero(mask.any(axis=axis)) for axis in (1, 0))
    return tuple(slice(max(0, a[0] - margin), a[-1] + 1 + margin) for a in (rows, columns))


def _in_full(part: np.ndarray, box: tuple[slice, slice], shape: tuple[int, int]) -> np.ndarray:
    full = np.zeros(shape, bool)
    full[box] = part
    return full


def _grabcut(
    image: np.ndarray, sure: np.ndarray, foreground: np.ndarray, background: np.ndarray
) -> np.ndarray:
    """GrabCut from what is certainly the object, probably the object, and certainly not; its largest part, filled."""
    cv2 = opencv()
    labels = np.full(image.shape[:2], cv2.GC_PR_BGD, np.uint8)
    labels[foreground], labels[background], labels[sure] = cv2.GC_PR_FGD, cv2.GC_BGD, cv2.GC_FGD
    inside = np.isin(labels, (cv2.GC_FGD, cv2.GC_PR_FGD))
    # GrabCut fits colours to both sides: it needs some pixels of each.
    if min(inside.sum(), (~inside).sum()) >= 10:
        cv2.setRNGSeed(0)
        models = np.zeros((1, 65)), np.zeros((1, 65))
        cv2.grabCut(image, labels, None, *models, _GRABCUT_ROUNDS, cv2.GC_INIT_WITH_MASK)
        inside = np.isin(labels, (cv2.GC_FGD, cv2.GC_PR_FGD))
    return _component(inside)


def without_print(pixels: np.ndarray, corners: np.ndarray) -> np.ndarray:
    """A picture whose printed board is hidden under floor: it stands out more than most objects.

    What is neutral inside the board is taken for print, under the tint of its white; what has colour and lies on the
    board stays. A hidden pixel has the colour of one around the board, drawn at random, so that neither pattern nor
    edge is left.

    Args:
        pixels: (H, W, 3), uint8.
        corners: of the board in the picture, in their order, (4, 2) [px]; they may lie outside.
    """
    cv2 = opencv()
    outlines = [np.zeros(pixels.shape[:2], np.uint8) for _ in range(2)]
    middle = corners.mean(axis=0)
    for outline, size in zip(outlines, (1.0, _AROUND)):
        cv2.fillConvexPoly(outline, np.rint(middle + size * (corners - middle)).astype(np.int32), 1)
    inside = outlines[0].astype(bool)
    around = pixels[outlines[1].astype(bool) & ~inside]
    if not inside.any() or len(around) == 0:
        return pixels
    smooth = cv2.medianBlur(pixels, 3)[inside].astype(np.float32)
    brightness = smooth.max(axis=1)
    white = np.median(smooth[brightness >= np.quantile(brightness, 0.8)], axis=0)
    balanced = smooth * (white.max() / np.maximum(white, 1))
    neutral = np.ptp(balanced, axis=1) < _NEUTRAL[0] + _NEUTRAL[1] * balanced.max(axis=1)
    hidden = inside.copy()
    hidden[inside] = neutral
    hidden = cv2.morphologyEx(hidden.view(np.uint8), cv2.MORPH_CLOSE, _cross()).view(bool) & inside
    plain = pixels.copy()
    plain[hidden] = around[np.random.default_rng(0).integers(len(around), size=int(hidden.sum()))]
    return plain


def photograph_mask(
    pixels: np.ndarray,
    saliency: Callable[[np.ndarray], np.ndarray],
    name: str | Path,
    board: np.ndarray | None = None,
) -> np.ndarray:
    """Mask of the object in a photograph.

    Args:
        pixels: the picture.
        saliency: `neuma_lib.capture.saliency.Saliency`, or another that gives (H, W) in [0, 1].
        name: of the file, for messages.
        board: corners of the printed board in the picture, (4, 2) [px]; None: there is none, or it is not in view.

    Raises:
        InputError: nothing stands out.
    """
    cv2 = opencv()
    height, width = pixels.shape[:2]
    scale = min(1.0, _LONGEST / max(height, width))
    small = cv2.resize(pixels, (round(width * scale), round(height * scale)), interpolation=cv2.INTER_AREA)
    probability = saliency(small if board is None else without_print(small, scale * board))
    likely = _component(probability > 0.5)
    if not likely.any():
        raise InputError(
            f"{name}: the mask is empty, nothing stands out: photograph the object closer and before a plain ground,"
            f" leave the picture out, or give a mask of your own"
        )
    radius = np.sqrt(likely.sum() / np.pi)
    reach = _grown(likely, max(3, round(0.1 * radius)))
    sure = _shrunk(likely & (probability > 0.9), max(1, round(0.08 * radius)))
    mask = _grabcut(small, sure, likely, ~reach | (probability < 0.02))
    if not mask.any():
        mask = likely
    return cv2.resize(mask.astype(np.float32), (width, height), interpolation=cv2.INTER_LINEAR) > 0.5


def read_mask(path: str | Path, size: tuple[int, int]) -> np.ndarray:
    """A mask of the user's: opaque where the picture has transparency, else where it is brighter than half, (H, W).

    Args:
        path: PNG, JPEG or WebP.
        size: width and height of the picture that it belongs to [px].

    Raises:
        InputError: missing, damaged, of another size, or empty.
    """
    content = existing(path, "put the mask there, or remove it from the settings").read_bytes()
    with open_image(content, path) as image, reading(path, "a mask"):
        image.load()
        clear = "A" in image.mode or "transparency" in image.info
        mask = np.asarray(image.convert("RGBA").getchannel("A") if clear else image.convert("L")) > 127
    if mask.shape[::-1] != tuple(size):
        raise InputError(
            f"{path} is {mask.shape[1]}x{mask.shape[0]}, its picture {size[0]}x{size[1]}: make the mask at that size"
        )
    check_not_empty(mask, path)
    return mask


def matted(pixels: np.ndarray, mask: np.ndarray) -> np.ndarray:
    """The object with a soft edge, straight-alpha RGBA (H, W, 4), uint8.

    Colours within two pixels of the edge, and outside, are those of the nearest pixel further in: a pixel at the edge
    shows the floor, too, which must not bleed into the object.
    """
    cv2 = opencv()
    alpha = cv2.GaussianBlur(mask.astype(np.float32), (0, 0), EDGE)
    inside = ndimage.binary_erosion(mask, iterations=2, border_value=1)
    if not inside.any():
        inside = mask
    colours = pixels
    if inside.any():
        row, column = ndimage.distance_transform_edt(~inside, return_distances=False, return_indices=True)
        colours = pixels[row, column]
    return np.dstack([colours, np.rint(255 * alpha).astype(np.uint8)])


def overlay(frame: Frame, mask: np.ndarray) -> Frame:
    """A frame with the ground darkened and the mask outlined in red, for `neuma_lib.capture.frames.contact_sheet`."""
    shown = np.where(mask[..., None], frame.pixels, frame.pixels // 2)
    width = max(1, frame.pixels.shape[1] // 400)  # to be seen on a contact sheet
    shown[ndimage.binary_dilation(mask, iterations=width) & ~mask] = (255, 0, 0)
    return frame._replace(pixels=shown.astype(np.uint8))


def iou(a: np.ndarray, b: np.ndarray) -> float:
    """Intersection over union of two masks; 1 where both are empty."""
    union = np.logical_or(a, b).sum()
    return float(np.logical_and(a, b).sum() / union) if union else 1.0


def area_jumps(areas: np.ndarray) -> np.ndarray:
    """|Change| of the area (T,) from frame to frame, as a part of the smaller one, (T - 1,)."""
    areas = np.asarray(areas, float)
    return np.abs(np.diff(areas)) / np.maximum(np.minimum(areas[1:], areas[:-1]), 1)


def check_not_empty(mask: np.ndarray, name: str | Path, frame: int | None = None) -> None:
    """Raises InputError where a mask has no pixel."""
    if not mask.any():
        raise InputError(
            f"{_where(name, frame)}: the mask is empty, the object was not found: cut the video to the frames that"
            f" show it, film against a ground of another colour, or give a mask of your own"
        )


def check_background(moving: np.ndarray, name: str | Path) -> None:
    """Raises InputError where more than `MOST_MOVING` of a picture moves besides the object, (T,)."""
    worst = int(np.argmax(moving))
    if moving[worst] > MOST_MOVING:
        raise InputError(
            f"{_where(name, worst)}: the background moves, {moving[worst]:.0%} of the picture differ from the empty"
            f" one besides the object: fix the camera, take the empty picture from the same place, lock focus and"
            f" exposure, and keep hands out of the picture"
        )


def check_flight(masks: np.ndarray, name: str | Path, frames: Sequence[int]) -> np.ndarray:
    """Check the masks of free flight: none empty, none at the picture's border, no sudden change of area.

    Args:
        masks: of the whole video, (T, H, W).
        name: of the file, for messages.
        frames: numbers of the frames before contact.

    Returns:
        `area_jumps` of these frames.

    Raises:
        InputError: names file and frame.
    """
    for i in frames:
        check_not_empty(masks[i], name, i)
        if _cut(masks[i]):
            raise InputError(
                f"{_where(name, i)}: the object leaves the picture: leave this frame out, or film from farther away"
            )
    jumps = area_jumps(masks[list(frames)].sum(axis=(1, 2)))
    if len(jumps) and jumps.max() > MOST_JUMP:
        worst = int(np.argmax(jumps))
        raise InputError(
            f"{_where(name, frames[worst + 1])}: the mask's area changes by {jumps[worst]:.0%} from the frame before,"
            f" in free flight: look at the contact sheet; a hand, a shadow or a ground of the object's colour may be"
            f" in the mask; leave such frames out, or give masks of your own"
        )
    return jumps


def _where(name: str | Path, frame: int | None) -> str:
    return f"{name}" if frame is None else f"{name}, frame {frame}"
