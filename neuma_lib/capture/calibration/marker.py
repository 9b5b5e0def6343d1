"""Pose of a camera from one square marker."""

import numpy as np

from neuma_lib.capture.tools import opencv
from neuma_lib.errors import InputError


def marker_poses(corners: np.ndarray, pixels: np.ndarray, K: np.ndarray) -> list[np.ndarray]:
    """Both poses (4, 4) of a square marker in the camera's frame, the one with the smaller error first.

    Perspective distinguishes them only if the marker is large in the image. The second is the first mirrored at the
    line of sight (Collins and Bartoli 2014).

    Args:
        corners: (4, 3) [m] in the marker's frame: top left, top right, bottom right, bottom left, centred, z = 0.
        pixels: (4, 2) [px], pixel centres as in K.
        K: (3, 3) [px].

    Raises:
        InputError: the corners are not those of a square in front of a camera.
    """
    cv2 = opencv()
    count, rotations, shifts, _ = cv2.solvePnPGeneric(
        corners, pixels, K, None, flags=cv2.SOLVEPNP_IPPE_SQUARE
    )
    poses = []
    for rotation, shift in zip(rotations, shifts):
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = cv2.Rodrigues(rotation)[0], shift.ravel()
        if np.isfinite(pose).all() and pose[2, 3] > 0:
            poses.append(pose)
    if not count or not poses:
        raise InputError("marker", f"its corners {np.round(pixels, 1).tolist()} px are not those of a square")
    return poses
