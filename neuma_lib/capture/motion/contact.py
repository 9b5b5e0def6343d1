"""Time and place at which a falling object touches the floor, from its masks."""

from collections.abc import Sequence

import numpy as np

from neuma_lib.capture.masks.regions import centroid, radius_of


def place_on_floor(mask: np.ndarray, viewmat: np.ndarray, K: np.ndarray) -> tuple[np.ndarray, float] | None:
    """Centre (3,) of an object that touches the floor at y = 0, from one view, and the relative error of its distance.

    The ray through the lowest point of the silhouette meets the floor in front of the centre: by R tan(e / 2) for a
    ball of radius R that is seen from an elevation e, and by nothing for a flat object that faces the camera. The ball
    is assumed, with half of the difference as standard deviation. None if the camera does not look down at the object.

    Args:
        mask: Boolean, (H, W), not empty.
        viewmat: world to camera, OpenCV axes, (4, 4).
        K: intrinsics [px], pixel centres at +0.5, (3, 3).
    """
    eye, rays = _rays(mask, viewmat, K)
    middle = viewmat[:3, :3].T @ np.linalg.solve(K, np.append(centroid(mask), 1.0))
    if eye[1] <= 0 or rays[1].min() >= 0 or middle[1] >= 0:
        return None
    down = rays[:, rays[1] < 0]
    hit = float((eye[1] / -down[1] * np.hypot(down[0], down[2])).min())
    elevation = np.arctan2(eye[1], hit)
    shift = radius_of(mask) / K[0, 0] * np.hypot(hit, eye[1]) * np.tan(elevation / 2)
    distance = hit + shift
    centre = eye + distance / np.hypot(middle[0], middle[2]) * middle
    return centre, 0.5 * float(shift) / distance


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
    heights = []
    for mask, centre in zip(masks, centres):
        eye, rays = _rays(mask, viewmat, K)
        towards = (centre - eye) * (1.0, 0.0, 1.0)
        reach = towards @ towards / np.maximum(towards @ rays, 1e-9)
        heights.append((eye[1] + reach * rays[1]).min())
    return np.array(heights)


def _rays(mask: np.ndarray, viewmat: np.ndarray, K: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Centre of a camera (3,) and directions (3, P) in the world of the rays through the pixels of a mask."""
    rows, columns = np.nonzero(mask)
    pixels = np.stack([columns + 0.5, rows + 0.5, np.ones(len(rows))])
    return -viewmat[:3, :3].T @ viewmat[:3, 3], viewmat[:3, :3].T @ np.linalg.solve(K, pixels)


def contact_time(times: Sequence[np.ndarray], heights: Sequence[np.ndarray]) -> float:
    """Time of contact with the floor [s], median over the cameras, or infinity.

    From the times of frames (T,) of each camera on a common clock [s] and their `lowest_points` (T,) [m].
    """
    touched = [clock[low < 0] for clock, low in zip(times, heights)]
    return float(np.median([clock[0] if len(clock) else np.inf for clock in touched]))
