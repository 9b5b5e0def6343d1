"""Cameras of the benchmark: static views on a sphere, and video views on a ring. Independent of Blender.

World frame: y up [m]. A pose is a camera-to-world matrix with OpenGL axes (x right, y up, looking along -z), as in
``transforms.json`` and in Blender. The centre of pixel (0, 0) is at (0.5, 0.5), y of the image points down.
"""

from dataclasses import dataclass

import numpy as np

FIELD_OF_VIEW = 30.0  # full horizontal field of view of every camera [degrees], narrow for weak perspective


@dataclass(frozen=True)
class Views:
    """Pinhole cameras with common intrinsics, square pixels, and the principal point at the image centre."""

    c2w: np.ndarray  # camera-to-world matrices, OpenGL axes, shape (V, 4, 4) [m]
    focal: float  # focal length [px]
    # width, height: image size [px]
    width: int
    height: int

    def __len__(self) -> int:
        return len(self.c2w)

    @property
    def K(self) -> np.ndarray:
        """Intrinsic matrix, shape (3, 3) [px]."""
        return np.array(
            [[self.focal, 0.0, self.width / 2], [0.0, self.focal, self.height / 2], [0.0, 0.0, 1.0]]
        )

    @property
    def viewmats(self) -> np.ndarray:
        """World-to-camera matrices with OpenCV axes (x right, y down, z forward), shape (V, 4, 4)."""
        return np.linalg.inv(self.c2w @ np.diag([1.0, -1.0, -1.0, 1.0]))

    def project(self, points: np.ndarray) -> np.ndarray:
        """Pixel coordinates (V, n, 2) of world points (n, 3) [m]."""
        camera = np.einsum("vij,nj->vni", self.viewmats[:, :3, :3], points) + self.viewmats[:, None, :3, 3]
        image = camera @ self.K.T
        return image[..., :2] / image[..., 2:]


def look_at(eye: np.ndarray, target: np.ndarray) -> np.ndarray:
    """Pose (4, 4) of an upright camera at ``eye`` that faces ``target`` [m], not straight up or down."""
    back = np.asarray(eye, dtype=np.float64) - target
    back /= np.linalg.norm(back)
    right = np.cross([0.0, 1.0, 0.0], back)
    right /= np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3, :3] = np.stack([right, np.cross(back, right), back], axis=1)
    pose[:3, 3] = eye
    return pose


def sphere_directions(count: int) -> np.ndarray:
    """Evenly distributed unit vectors (count, 3) on the sphere (Fibonacci lattice about y, without poles)."""
    index = np.arange(count) + 0.5
    y = 1.0 - 2.0 * index / count
    angle = np.pi * (1.0 + 5.0**0.5) * index
    radius = np.sqrt(1.0 - y**2)
    return np.stack([radius * np.cos(angle), y, radius * np.sin(angle)], axis=1)


def ring_directions(count: int) -> np.ndarray:
    """Unit vectors (count, 3) towards the video cameras, ``count`` at most 10.

    The first is +z, so the frontal camera is horizontal with (x, y) as image plane. The others are slightly above the
    object, at azimuths in steps of 108 degrees, which gives ten positions and distributes any first few of them.
    """
    if not 1 <= count <= 10:
        raise ValueError(f"a ring has 1 to 10 views, not {count}")
    azimuth = np.radians(108.0 * np.arange(count))
    elevation = np.radians(
        np.where(np.arange(count) == 0, 0.0, np.where(np.arange(count) % 2 == 1, 15.0, 25.0))
    )
    return np.stack(
        [np.cos(elevation) * np.sin(azimuth), np.sin(elevation), np.cos(elevation) * np.cos(azimuth)], axis=1
    )


def framing(
    directions: np.ndarray, points: np.ndarray, width: int, height: int, *, fill: float = 0.92
) -> Views:
    """Cameras in the given directions, at the smallest common distance with every point in the frame.

    Args:
        directions: unit vectors from the centre of the points' bounding box to the cameras, shape (V, 3).
        points: points that must be visible [m], shape (n, 3), over all frames of a video.
        width, height: image size [px].
        fill: fraction of the half frame that the outermost point may reach.
    """
    points = np.asarray(points, dtype=np.float64).reshape(-1, 3)
    centre = (points.min(axis=0) + points.max(axis=0)) / 2
    tangent = np.tan(np.radians(FIELD_OF_VIEW) / 2) * np.array([1.0, height / width]) * fill
    distance = -np.inf
    for direction in directions:
        axes = look_at(centre + direction, centre)[:3, :3]
        local = (points - centre) @ axes
        # |x| <= tangent * depth with depth = distance - local z
        distance = max(distance, (np.abs(local[:, :2]) / tangent + local[:, 2:]).max())
    poses = [look_at(centre + distance * direction, centre) for direction in directions]
    focal = width / 2 / np.tan(np.radians(FIELD_OF_VIEW) / 2)
    return Views(np.stack(poses), float(focal), width, height)


def static_views(points: np.ndarray, count: int, width: int, height: int) -> Views:
    """Evenly distributed cameras on a sphere around points (n, 3) [m], which fill the frame of the tightest view."""
    return framing(sphere_directions(count), points, width, height)


def video_views(points: np.ndarray, count: int, width: int, height: int) -> Views:
    """Static cameras on a ring that see points (n, 3) [m] of all frames; view 0 is the frontal one."""
    return framing(ring_directions(count), points, width, height)
