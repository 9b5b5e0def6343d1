"""Hexahedra of solids that consist of blocks."""

import numpy as np
import pytest
import trimesh

from neuma_lib.geometry.blocks import hexahedra
from tests.support.errors import refused

pytestmark = pytest.mark.core


def step_shape():
    """An L-shaped prism of 4 x 3 x 1 with a notch of 2 x 2: the surface of two blocks with one common face."""
    outline = np.array([(0, 0), (4, 0), (4, 1), (2, 1), (2, 3), (0, 3)], dtype=float)
    bottom, top = (np.column_stack([outline, np.full(6, z)]) for z in (0.0, 1.0))
    caps = np.array([(0, 1, 2), (0, 2, 3), (0, 3, 4), (0, 4, 5)])
    sides = np.array([(i, (i + 1) % 6, (i + 1) % 6 + 6, i + 6) for i in range(6)])
    faces = [caps[:, ::-1], caps + 6, sides[:, [0, 1, 2]], sides[:, [0, 2, 3]]]
    return trimesh.Trimesh(np.concatenate([bottom, top]), np.concatenate(faces), process=False)


@pytest.mark.parametrize("size", [10.0, 1.0, 0.3])
def test_elements_fill_the_solid_and_are_no_larger_than_asked(size):
    mesh = step_shape()
    body = hexahedra(mesh, size, [(3.0, 0.9, 0.5)])
    assert body.node_volumes.sum() == pytest.approx(mesh.volume) and mesh.volume == pytest.approx(8)
    low, high = (body.nodes[body.cells].min(axis=1), body.nodes[body.cells].max(axis=1))
    assert (high - low).max() <= size + 1e-9
    for axis, plane in enumerate((3.0, 0.9, 0.5)):  # elements end at the given corner
        assert not ((low[:, axis] < plane - 1e-9) & (high[:, axis] > plane + 1e-9)).any()
    weights, triangles = body.surface(size)
    surface = trimesh.Trimesh(weights @ body.nodes, triangles, process=False)
    assert surface.is_watertight and surface.area == pytest.approx(mesh.area)


def test_other_solids_are_refused():
    with refused("mesh", problem="not parallel"):
        hexahedra(trimesh.creation.icosphere(), 0.1)
    with refused("mesh", problem="watertight"):
        hexahedra(trimesh.Trimesh(step_shape().vertices, step_shape().faces[1:]), 0.1)
