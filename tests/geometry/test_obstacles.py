"""Surfaces of colliders for pictures, and which views they hide."""

import numpy as np
import pytest
import torch
import trimesh

from neuma_lib.geometry.mesh_collider import mesh_collider
from neuma_lib.geometry.obstacles import obstacles, sees_all
from neuma_lib.sim.colliders import Collider

TIMES = [0.0, 0.4]
MOTION = {
    "centre": (0.4, 0.5, 0.6),
    "rotation": (0.3, -0.2, 0.5),
    "velocity": (1.0, 0.0, 2.0),
    "spin": (0.0, 2.0, 1.0),
}
COLLIDERS = [
    Collider("plane", **MOTION),
    Collider("box", (0.1, 0.2, 0.3), **MOTION),
    Collider("sphere", (0.2,), **MOTION),
    Collider("capsule", (0.3, 0.1), **MOTION),
]


@pytest.mark.parametrize("collider", COLLIDERS, ids=lambda collider: collider.shape)
def test_a_drawn_surface_is_that_of_the_simulation(collider):
    """Its vertices are at the distance 0, and its faces point to where distances increase."""
    (obstacle,) = obstacles([collider], TIMES)
    assert obstacle.moves
    for frame, time in enumerate(TIMES):
        vertices = obstacle.placed(frame)
        distance, _ = collider.surface(torch.from_numpy(vertices), time)
        assert float(distance.abs().max()) < 1e-12
        corners = vertices[obstacle.faces]
        outwards = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        _, normal = collider.surface(torch.from_numpy(corners.mean(axis=1)), time)
        assert ((outwards * normal.numpy()).sum(axis=1) > 0).all()


def test_a_drawn_mesh_has_its_size():
    """A ball of 0.2 m on a grid with a spacing h of 0.26 m / 16: its surface is within h of the ball's."""
    collider = mesh_collider(trimesh.creation.icosphere(3, radius=0.1), 16, centre=(0.5, 0.5, 0.5))
    (obstacle,) = obstacles([collider], [0.0])
    radius = np.linalg.norm(obstacle.placed(0) - 0.5, axis=1)
    assert not obstacle.moves and np.abs(radius - 0.1).max() < 0.26 / 16


def test_views_behind_an_obstacle_do_not_see_the_whole_body():
    """A wall at x = 0.7 that hides points below y = 0.5 from an eye at the same height as its upper edge."""
    wall = Collider("box", (0.01, 0.25, 1.0), (0.7, 0.25, 0.5))
    eyes = np.array([[2.0, 0.5, 0.5], [-2.0, 0.5, 0.5], [0.5, 3.0, 0.5]])
    low, high = np.array([[0.5, 0.3, 0.5]]), np.array([[0.5, 0.6, 0.5]])
    assert sees_all([wall], eyes, high).tolist() == [True, True, True]
    assert sees_all([wall], eyes, np.concatenate([low, high])).tolist() == [False, True, True]
    assert sees_all([], eyes, low).all()
