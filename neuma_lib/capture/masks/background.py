"""Background of a fixed camera: median of frames, exposure of a frame, and difference from the background.

Pictures are RGB, uint8, (H, W, 3).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from neuma_lib.capture.tools import opencv

_MAX_BACKGROUND_FRAMES = 61  # number of frames in the median
_SHADOW = (0.4, 0.97)  # range of the factor by which a shadow darkens
_SHADOW_TINT = 0.06  # maximum difference between the factors of the channels in a shadow


def median_background(frames: Sequence[np.ndarray]) -> np.ndarray:
    """Background as the median of frames (H, W, 3), uint8, correct where the object covers fewer than half of them."""
    chosen = np.linspace(0, len(frames) - 1, min(len(frames), _MAX_BACKGROUND_FRAMES)).round().astype(int)
    return np.median(np.stack([frames[i] for i in chosen]), axis=0).round().astype(np.uint8)


def match_exposure(frame: np.ndarray, background: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Gain and offset of each channel, (3,) each, such that frame = gain * background + offset where nothing moved.

    Trimmed least squares, valid if moving objects cover less than half of the picture. Pixels with equal levels in both
    pictures are one value, weighted with their number.
    """
    gains, offsets = np.ones(3), np.zeros(3)
    step = max(1, int(np.sqrt(frame[..., 0].size / 5e4)))  # two unknowns do not need every pixel
    for c in range(3):
        seen, empty = (p[::step, ::step, c].ravel().astype(np.int64) for p in (frame, background))
        counts = np.bincount(256 * empty + seen, minlength=256 * 256).reshape(256, 256)
        counts[[*range(5), *range(251, 256)]] = counts[:, [*range(5), *range(251, 256)]] = 0  # clipped
        empty, seen = np.nonzero(counts)
        weights = counts[empty, seen]
        if weights.sum() < 100:
            continue
        residual = np.abs(seen - weighted_quantile(seen / empty, weights, 0.5) * empty)
        kept = residual <= weighted_quantile(residual, weights, 0.6)
        for _ in range(8):
            share = weights * kept / weights[kept].sum()
            x, y = share @ empty, share @ seen
            variance = share @ (empty - x) ** 2
            # In a background of one brightness, offset and gain are indistinguishable.
            gain = share @ ((empty - x) * (seen - y)) / variance if variance > 4**2 else y / x
            offset = y - gain * x
            residual = np.abs(seen - gain * empty - offset)
            kept = residual <= max(2.0, 3 * 1.4826 * weighted_quantile(residual, weights, 0.5))
        gains[c], offsets[c] = gain, offset
    return gains, offsets


def weighted_quantile(values: np.ndarray, counts: np.ndarray, share: float) -> float:
    """`np.quantile` of values (N,) that occur several times each, (N,)."""
    order = np.argsort(values)
    below = np.cumsum(counts[order])
    rank = share * (below[-1] - 1)
    low, high = values[order[np.searchsorted(below, [np.floor(rank), np.ceil(rank)], side="right")]]
    return float(low + (rank % 1) * (high - low))


def exposed(background: np.ndarray, gain: np.ndarray, offset: np.ndarray) -> np.ndarray:
    return background * gain.astype(np.float32) + offset.astype(np.float32)


def compare(frame: np.ndarray, expected: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Difference of a frame from the background at its exposure, (H, W, 3), float32, and the mask of shadows, (H, W).

    A shadow darkens all channels by nearly the same factor. Factors are from medians over 5 x 5 pixels, which suppress
    noise and keep the edge between an object and its shadow.
    """
    cv2 = opencv()
    pictures = [np.maximum(picture.astype(np.float32), 0) for picture in (frame, expected)]
    seen, empty = (cv2.medianBlur(picture, 5) for picture in pictures)
    factor = seen / np.maximum(empty, 1.0)
    spread = largest_channel(factor) + largest_channel(-factor)
    mean = (factor[..., 0] + factor[..., 1] + factor[..., 2]) / 3
    return pictures[0] - expected, (mean > _SHADOW[0]) & (mean < _SHADOW[1]) & (spread < _SHADOW_TINT)


def largest_channel(picture: np.ndarray) -> np.ndarray:
    """Maximum of the three channels, (H, W). np.max along so short an axis takes ten times as long."""
    return np.maximum(np.maximum(picture[..., 0], picture[..., 1]), picture[..., 2])
