"""Masks of the object in photographs: salient object by a network, edge by GrabCut (Rother et al. 2004).

Pictures are RGB, uint8, (H, W, 3). Masks are Boolean, (H, W).
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np

from neuma_lib.capture.masks.regions import component, cross, grabcut, grown, radius_of, shrunk
from neuma_lib.capture.tools import opencv
from neuma_lib.errors import InputError

_LONGEST = 800  # side of a photograph for GrabCut [px]
_AROUND = 1.3  # size of the sampled floor around a board, in boards
_NEUTRAL = (12.0, 0.12)  # range of the channels of a neutral pixel: levels, and share of the largest channel


def photograph_mask(
    pixels: np.ndarray,
    saliency: Callable[[np.ndarray], np.ndarray],
    name: str | Path,
    board: np.ndarray | None = None,
) -> np.ndarray:
    """Mask of the object in a photograph.

    Args:
        pixels: the picture.
        saliency: `neuma_lib.capture.masks.saliency.Saliency`, or another function that returns (H, W) in [0, 1].
        name: of the file for messages.
        board: corners of the printed board in the picture, (4, 2) [px]. None if there is none or it is not visible.

    Raises:
        InputError: no salient object.
    """
    cv2 = opencv()
    height, width = pixels.shape[:2]
    scale = min(1.0, _LONGEST / max(height, width))
    small = cv2.resize(pixels, (round(width * scale), round(height * scale)), interpolation=cv2.INTER_AREA)
    probability = saliency(small if board is None else without_print(small, scale * board))
    likely = component(probability > 0.5)
    if not likely.any():
        raise InputError(
            name,
            "the mask is empty, no salient object was detected",
            "Select the object with a box (`object` in capture.yaml), photograph it closer and in front of a plain"
            " background, leave the picture out, or provide a mask",
        )
    radius = radius_of(likely)
    reach = grown(likely, max(3, round(0.1 * radius)))
    sure = shrunk(likely & (probability > 0.9), max(1, round(0.08 * radius)))
    mask = grabcut(small, sure, likely, ~reach | (probability < 0.02))
    if not mask.any():
        mask = likely
    return cv2.resize(mask.astype(np.float32), (width, height), interpolation=cv2.INTER_LINEAR) > 0.5


def without_print(pixels: np.ndarray, corners: np.ndarray) -> np.ndarray:
    """Replace the printed board in a picture by floor, since it is more salient than most objects.

    Pixels inside the board that are neutral relative to its white are print. Coloured ones belong to objects on the
    board and are kept. Print is replaced by random pixels around the board, which leaves no pattern and no edge.

    Args:
        pixels: (H, W, 3), uint8.
        corners: of the board in the picture, in order, (4, 2) [px], possibly outside the picture.
    """
    cv2 = opencv()
    polygons = [np.zeros(pixels.shape[:2], np.uint8) for _ in range(2)]
    middle = corners.mean(axis=0)
    for polygon, size in zip(polygons, (1.0, _AROUND)):
        cv2.fillConvexPoly(polygon, np.rint(middle + size * (corners - middle)).astype(np.int32), 1)
    inside = polygons[0].astype(bool)
    around = pixels[polygons[1].astype(bool) & ~inside]
    if not inside.any() or len(around) == 0:
        return pixels
    smooth = cv2.medianBlur(pixels, 3)[inside].astype(np.float32)
    brightness = smooth.max(axis=1)
    white = np.median(smooth[brightness >= np.quantile(brightness, 0.8)], axis=0)
    balanced = smooth * (white.max() / np.maximum(white, 1))
    neutral = np.ptp(balanced, axis=1) < _NEUTRAL[0] + _NEUTRAL[1] * balanced.max(axis=1)
    hidden = inside.copy()
    hidden[inside] = neutral
    hidden = cv2.morphologyEx(hidden.view(np.uint8), cv2.MORPH_CLOSE, cross()).view(bool) & inside
    plain = pixels.copy()
    plain[hidden] = around[np.random.default_rng(0).integers(len(around), size=int(hidden.sum()))]
    return plain
