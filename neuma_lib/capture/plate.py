"""The empty scene of a fixed camera: the median of frames, the exposure of a frame, and what differs from the scene.

Pictures are RGB, uint8, (H, W, 3).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from neuma_lib.capture.tools import opencv

MOST_PLATE_FRAMES = 61
"""Frames of which the median is taken where there is no empty still."""
SHADOW = (0.4, 0.97)
"""Factors by which a shadow darkens."""
SHADOW_TINT = 0.06
"""Most difference between the factors of the channels in a shadow."""


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


def exposed(plate: np.ndarray, gain: np.ndarray, offset: np.ndarray) -> np.ndarray:
    return plate * gain.astype(np.float32) + offset.astype(np.float32)


def compare(frame: np.ndarray, expected: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Difference of a frame from the plate at its exposure, (H, W, 3), float32, and where it is a shadow, (H, W).

    A shadow darkens every channel by nearly the same factor. The factors are those of medians over 5 x 5 pixels, which
    noise changes little, and which keep the edge between an object and its shadow.
    """
    cv2 = opencv()
    pictures = [np.maximum(picture.astype(np.float32), 0) for picture in (frame, expected)]
    seen, empty = (cv2.medianBlur(picture, 5) for picture in pictures)
    factor = seen / np.maximum(empty, 1.0)
    spread = largest_channel(factor) + largest_channel(-factor)
    mean = (factor[..., 0] + factor[..., 1] + factor[..., 2]) / 3
    return pictures[0] - expected, (mean > SHADOW[0]) & (mean < SHADOW[1]) & (spread < SHADOW_TINT)


def largest_channel(picture: np.ndarray) -> np.ndarray:
    """Largest of the three channels, (H, W); numpy's own maximum along so short an axis takes ten times as long."""
    return np.maximum(np.maximum(picture[..., 0], picture[..., 1]), picture[..., 2])
