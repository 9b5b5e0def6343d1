"""The outline of a projected mesh against a twin that fills pixels, and a sphere."""

import numpy as np
import pytest
import trimesh
from scipy.ndimage import binary_erosion

from neuma_lib.geometry.outline import outline, silhouette

pytestmark = pytest.mark.core


def bodies():
    torus = trimesh.creation.torus(1.0, 0.4, 60, 30)  # with a hole, whose edge is outline, too
    boxes = trimesh.util.concatenate(
        [
            trimesh.creation.box((1, 2, 0.5)),
            trimesh.creation.box((2.5, 0.4, 0.4)).apply_translation((1, 0.5, 1)),
        ]
    )
    return {"torus": torus, "boxes": boxes.subdivide().subdivide()}


@pytest.mark.parametrize("name", ["torus", "boxes"])
@pytest.mark.parametrize("seed", [1, 2, 3])
def test_the_outline_is_the_boundary_of_the_filled_silhouette(name, seed):
    mesh = bodies()[name]
    R = trimesh.transformations.random_rotation_matrix(np.random.default_rng(seed).uniform(size=3))[:3, :3]
    pixels = (mesh.vertices @ R.T)[:, :2] * 60 + 150
    mask = silhouette(pixels, mesh.faces, 300, 300)
    boundary = mask & ~binary_erosion(mask)
    centres = np.argwhere(boundary)[:, ::-1] + 0.5
    edge = outline(pixels, mesh.faces)
    _, _, offsets = edge.nearest(pixels, centres)
    # a boundary pixel's centre is within sqrt(2) px of the outline, which ends up to a quarter of an edge early
    distances = np.linalg.norm(offsets, axis=1)
    longest = np.linalg.norm(np.diff(pixels[edge.vertices], axis=1), axis=2).max() / 4
    assert np.quantile(distances, 0.98) < 2**0.5 and distances.max() < 2**0.5 + longest
    ends = edge.ends(pixels).reshape(-1, 2)
    nearest = np.linalg.norm(ends[:, None] - centres, axis=2).min(axis=1)
    assert np.quantile(nearest, 0.98) < 2 and nearest.max() < 2 + longest


def test_nearest_points_are_those_of_the_mesh():
    sphere = trimesh.creation.icosphere(4, 50.0)
    pixels = sphere.vertices[:, :2] + 100
    edge = outline(pixels, sphere.faces)
    angles = np.linspace(0, 2 * np.pi, 41)
    points = 100 + 57 * np.stack([np.cos(angles), np.sin(angles)], axis=1)
    segment, share, offsets = edge.nearest(pixels, points)
    a, b = pixels[edge.vertices[segment]].transpose(1, 0, 2)
    np.testing.assert_allclose(a + share[:, None] * (b - a), points + offsets, atol=1e-9)
    # chords of a circle of radius 50 of length 4 lie at most 4^2 / (8 * 50) inside
    np.testing.assert_allclose(np.linalg.norm(offsets, axis=1), 7, atol=0.06)
