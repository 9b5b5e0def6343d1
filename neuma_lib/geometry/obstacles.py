"""Surfaces of colliders and their motion, for pictures and other programs."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
import trimesh
from skimage.measure import marching_cubes

from neuma_lib.sim.colliders import Collider

GREY = (0.49, 0.51, 0.54)  # colour of colliders, sRGB
SIGHTS, SAMPLES = 300, 200  # points of a body and points of each line of sight that are tested for obstacles
PLANE_REACH = 0.75
"""Half the side of the square that stands for a plane [m]: the faces of the unit cube with a margin."""


@dataclass(frozen=True)
class Obstacle:
    """A rigid matte surface in motion."""

    vertices: np.ndarray  # in its own frame [m], shape (V, 3)
    faces: np.ndarray  # shape (M, 3), outward
    poses: np.ndarray  # from its frame to the world at each time, shape (T, 4, 4) [m]
    color: tuple[float, float, float] = GREY  # sRGB in [0, 1]
    opacity: float = 1.0  # less than 1 shows what is behind it

    @property
    def moves(self) -> bool:
        return bool((self.poses != self.poses[:1]).any())

    def placed(self, frame: int) -> np.ndarray:
        """Vertices in the world (V, 3) [m]."""
        axes, centre = self.poses[frame, :3, :3], self.poses[frame, :3, 3]
        return self.vertices @ axes.T + centre


def obstacles(colliders: Sequence[Collider], times: Sequence[float]) -> list[Obstacle]:
    """The surfaces of colliders at some times [s]."""
    result = []
    for collider in colliders:
        mesh, poses = _surface(collider), np.tile(np.eye(4), (len(times), 1, 1))
        for pose, time in zip(poses, times, strict=True):
            axes, centre = collider.pose(float(time))
            pose[:3, :3], pose[:3, 3] = axes.numpy(), centre.numpy()
        result.append(Obstacle(np.asarray(mesh.vertices), np.asarray(mesh.faces), poses))
    return result


def sees_all(colliders: Sequence[Collider], eyes: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Whether no collider is between an eye and the points of a body at t = 0, shape (E,).

    Args:
        eyes: shape (E, 3) [m].
        points: shape (n, 3) [m], of which at most `SIGHTS` are used.
    """
    seen = torch.from_numpy(np.asarray(points, float)[:: -(-len(points) // SIGHTS)])
    share = torch.linspace(0, 1, SAMPLES, dtype=torch.float64)[:, None, None]
    free = []
    for eye in torch.from_numpy(np.asarray(eyes, float)):
        x = eye + share * (seen - eye)
        free.append(all(bool((collider.surface(x)[0] >= 0).all()) for collider in colliders))
    return np.array(free)


def _surface(collider: Collider) -> trimesh.Trimesh:
    """Surface of a collider in its frame; of a plane a square around its centre."""
    size = collider.size
    if collider.shape == "box":
        return trimesh.creation.box(extents=2 * np.array(size))
    if collider.shape == "sphere":
        return trimesh.creation.icosphere(subdivisions=4, radius=size[0])
    if collider.shape == "capsule":
        mesh = trimesh.creation.capsule(height=2 * size[0], radius=size[1], count=[32, 32])
        return mesh.apply_transform(trimesh.geometry.align_vectors([0, 0, 1], [0, 1, 0]))
    if collider.distances is not None:
        grid = collider.distances
        corners, faces, _, _ = marching_cubes(grid.values.copy(), 0.0, gradient_direction="ascent")
        return trimesh.Trimesh(grid.lowest + grid.spacing * corners, faces, process=False)
    corners = PLANE_REACH * np.array([[-1, 0, -1], [-1, 0, 1], [1, 0, 1], [1, 0, -1]])
    return trimesh.Trimesh(corners, [[0, 1, 2], [0, 2, 3]], process=False)
