"""Motion of a camera that should be fixed, from tracked points of the background."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from neuma_lib.capture.tools import opencv
from neuma_lib.errors import InputError

MAX_SHIFT = 0.004
"""Tolerated shift of the background, as share of the longer side of the picture: 4 px of 1000."""
_POINTS = 200  # that are tracked
_MIN_POINTS = 15
_MAX_RETURN_ERROR = 0.5  # after tracking forward and backward [px]


def background_shift(reference: np.ndarray, picture: np.ndarray) -> float:
    """Median shift of the background between two pictures of one size, (H, W, 3), uint8 [px]. NaN without texture.

    Points of the whole picture are tracked (pyramidal Lucas and Kanade 1981), most of which belong to the background.
    """
    cv2 = opencv()
    first, second = (cv2.cvtColor(p, cv2.COLOR_RGB2GRAY) for p in (reference, picture))
    points = cv2.goodFeaturesToTrack(first, _POINTS, 0.01, max(first.shape) / 50)
    if points is None or len(points) < _MIN_POINTS:
        return np.nan
    ahead, tracked, _ = cv2.calcOpticalFlowPyrLK(first, second, points, None)
    back, returned, _ = cv2.calcOpticalFlowPyrLK(second, first, ahead, None)
    kept = (tracked.ravel() == 1) & (returned.ravel() == 1)
    kept &= np.linalg.norm((back - points)[:, 0], axis=1) < _MAX_RETURN_ERROR
    if kept.sum() < _MIN_POINTS:
        return np.nan
    return float(np.median(np.linalg.norm((ahead - points)[kept, 0], axis=1)))


def check_fixed(shifts: Sequence[float], numbers: Sequence[int], longest: int, name: str | Path) -> float:
    """Largest shift as share of the longer side of the pictures.

    Args:
        shifts: `background_shift` of some frames from the picture of the empty scene [px].
        numbers: of these frames.
        longest: longer side of the pictures [px].
        name: of the video for messages.

    Raises:
        InputError: the camera moves during the video, or was moved before it.
    """
    shares = np.array(shifts, float) / longest
    if not np.isfinite(shares).any():
        return 0.0
    worst, least = int(np.nanargmax(shares)), float(np.nanmin(shares))
    if shares[worst] <= MAX_SHIFT:
        return float(shares[worst])
    moved = f"{100 * shares[worst]:.1f} % of the picture in frame {numbers[worst]}, the limit is {100 * MAX_SHIFT:g} %"
    if least > MAX_SHIFT:
        raise InputError(
            name,
            f"the camera was moved between the picture of the empty scene and the video: the background is shifted by"
            f" {100 * least:.1f} to {moved}",
            "Save a frame of this video without the object as the picture of the empty scene",
        )
    raise InputError(
        name,
        f"the camera moves during the video: the background is shifted by up to {moved}",
        "Film with the camera on a tripod or leaned against something, with image stabilisation off, or cut the video"
        " to the part in which the camera is still",
    )
