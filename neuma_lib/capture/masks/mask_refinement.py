"""Refine the masks of an object in photographs jointly.

The network segments each photograph separately and sometimes misses a part, such as the cap of a bottle or a tail.
GrabCut learns colours from one picture and often includes the shadow under the object. The visual hull of all masks
(`agreement.common_body`) contains the missing part, known from other photographs, and excludes the shadow. Its
interior gives the colours of the object and its surroundings those of floor and shadow, over all photographs. The
refined edge, near that of the hull, minimises the log-likelihood ratio of the two plus the length of the outline.

Pictures are RGB, uint8, (H, W, 3). Masks are Boolean, (H, W).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from scipy import ndimage

from neuma_lib.capture.masks.agreement import common_body
from neuma_lib.capture.masks.regions import box_of, component, grown, in_full, radius_of, shrunk
from neuma_lib.capture.masks.silhouettes import UNSEEN, cheapest
from neuma_lib.capture.tools import opencv

_ROUNDS = 2  # iterations of hull, colours and masks
_BAND = 2.0  # distance between the edges of object and hull, in voxels
AROUND = 0.5
"""Width of the surroundings in which background colours are learned, in radii of the silhouette."""
_LONGEST = 800  # side of the reduced photographs [px]
_BINS = 32  # of each channel
_SPREAD = 1.0  # standard deviation of noise and exposure, in bins
_FLOOR = 1e-5  # share of an unobserved colour


class _View(NamedTuple):
    """Part of a photograph near the hull: size of the whole, box, pixels (h, w, 3), and where the object certainly and
    possibly is."""

    size: tuple[int, int]
    box: tuple[slice, slice]
    pixels: np.ndarray
    certain: np.ndarray
    possible: np.ndarray


def refined_masks(
    pictures: Sequence[np.ndarray],
    masks: Sequence[np.ndarray],
    viewmats: np.ndarray,
    Ks: np.ndarray,
    kept: Sequence[bool] | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> list[np.ndarray]:
    """Refined masks of the object in N >= 2 photographs.

    Args:
        pictures: the photographs.
        masks: initial masks, most of which show the object.
        viewmats, Ks: of the cameras, as for `common_body`.
        kept: which masks are not changed, (N,). None: all are refined.
        progress: called with the numbers of finished and of all steps.

    Raises:
        InputError: as `common_body`.
    """
    masks, total = list(masks), _ROUNDS * len(masks)
    for done in range(_ROUNDS):
        body = common_body(masks, viewmats, Ks)
        seen = (body.seen(p.shape[:2], *camera) for p, camera in zip(pictures, zip(viewmats, Ks)))
        candidates = (_view(p, *each) for p, each in zip(pictures, seen))
        views = {i: view for i, view in enumerate(candidates) if view is not None}
        parts = zip(*((v.pixels[v.certain], v.pixels[~v.possible]) for v in views.values()))
        ratio = log_ratio(*(colour_shares(np.concatenate(part)) for part in parts))
        for i, view in views.items():
            if kept is None or not kept[i]:
                refined = _segment(view, ratio, pictures[i].shape[:2])
                masks[i] = refined if refined.any() else masks[i]
            if progress:
                progress(done * len(masks) + i + 1, total)
    return masks


def _segment(view: _View, ratio: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
    cost = (-2 * ratio[colour_bins(view.pixels)]).clip(-UNSEEN, UNSEEN)
    cost = np.where(view.certain, -UNSEEN, np.where(view.possible, cost, UNSEEN))
    inside = in_full(component(cheapest(cost, view.pixels.astype(np.float32))), view.box, view.size)
    cv2 = opencv()
    return cv2.resize(inside.astype(np.float32), shape[::-1], interpolation=cv2.INTER_LINEAR) > 0.5


def _view(picture: np.ndarray, body: np.ndarray, voxel: float) -> _View | None:
    """None if the hull is not in the picture."""
    cv2 = opencv()
    height, width = body.shape
    scale = min(1.0, _LONGEST / max(height, width))
    size = round(width * scale), round(height * scale)
    likely = cv2.resize(body.astype(np.float32), size, interpolation=cv2.INTER_AREA) > 0.5
    if not likely.any():
        return None
    band = max(2, round(_BAND * scale * voxel))
    box = box_of(likely, band + round(AROUND * radius_of(likely)))
    pixels = cv2.resize(picture, size, interpolation=cv2.INTER_AREA)[box]
    return _View(likely.shape, box, pixels, shrunk(likely, band)[box], grown(likely, band)[box])


def colour_bins(pixels: np.ndarray) -> tuple[np.ndarray, ...]:
    """Bin of each channel of pixels (..., 3), which index the arrays of `colour_shares`."""
    return tuple(np.moveaxis(pixels.astype(int) * _BINS // 256, -1, 0))


def colour_shares(pixels: np.ndarray) -> np.ndarray:
    """Smoothed frequencies of the colours of pixels (P, 3), by bins of the three channels. 0 without pixels."""
    counts = np.zeros((_BINS,) * 3)
    np.add.at(counts, colour_bins(pixels), 1)
    return ndimage.gaussian_filter(counts / max(counts.sum(), 1), _SPREAD, mode="nearest")


def log_ratio(object_: np.ndarray, surroundings: np.ndarray) -> np.ndarray:
    """Logarithm of the ratio of two `colour_shares`."""
    return np.log(object_ + _FLOOR / _BINS) - np.log(surroundings + _FLOOR / _BINS)
