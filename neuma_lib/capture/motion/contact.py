"""Time at which a falling object touches the floor, from its masks."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np


def lowest_points(
    masks: Sequence[np.ndarray], centres: np.ndarray, viewmat: np.ndarray, K: np.ndarray
) -> np.ndarray:
    """Heights of the lowest points of an object, assuming the distance of its centre from the camera, (T,) [m].

    A camera that looks down sees the lowest points on the near side, where the assumption underestimates their height.
    An object above the floor by these heights has not touched it.

    Args:
        masks: Boolean, (H, W), T of them, none empty.
        centres: of the object in the room, y up, (T, 3) [m].
        viewmat: world to camera, OpenCV axes, (4, 4).
        K: intrinsics [px], pixel centres at +0.5, (3, 3).
    """
    R = viewmat[:3, :3]
    eye = -R.T @ viewmat[:3, 3]
    heights = []
    for mask, centre in zip(masks, centres):
        rows, columns = np.nonzero(mask)
        pixels = np.stack([columns + 0.5, rows + 0.5, np.ones(len(rows))])
        rays = R.T @ np.linalg.solve(K, pixels)
        towards = (centre - eye) * (1.0, 0.0, 1.0)
        reach = towards @ towards / np.maximum(towards @ rays, 1e-9)
        heights.append((eye[1] + reach * rays[1]).min())
    return np.array(heights)


def contact_time(times: Sequence[np.ndarray], heights: Sequence[np.ndarray]) -> float:
    """Time of contact with the floor [s], median over the cameras, or infinity.

    From the times of frames (T,) of each camera on a common clock [s] and their `lowest_points` (T,) [m].
    """
    touched = [clock[low < 0] for clock, low in zip(times, heights)]
    return float(np.median([clock[0] if len(clock) else np.inf for clock in touched]))
