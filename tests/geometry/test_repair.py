"""Repair of surfaces: the result is one closed body of even triangles, or an error."""

import sys

import numpy as np
import pytest
import trimesh

from neuma_lib.geometry import repair, shapes
from neuma_lib.geometry.repair import repaired
from neuma_lib.geometry.volume import check_mesh, volume_iou
from tests.support.errors import refused

EDGE = 0.01


@pytest.fixture(scope="module")
def letter():
    """With a hole through it, so that a repair that fills too much is noticed."""
    return shapes.build("letter_A", 0.3, resolution=40)


def plain(vertices, faces):
    return trimesh.Trimesh(vertices, faces, process=False)


def with_holes(letter):
    return plain(letter.vertices, np.delete(letter.faces, np.r_[100:160, 3000:3004, 5000], axis=0))


def next_to_others(letter):
    parts = [with_holes(letter), trimesh.creation.icosphere(2, 0.02).apply_translation([1, 1, 1])]
    return trimesh.util.concatenate(parts)


def without_shared_vertices(letter):
    return plain(letter.vertices[letter.faces].reshape(-1, 3), np.arange(letter.faces.size).reshape(-1, 3))


def turned_at_random(letter):
    faces = letter.faces.copy()
    turned = np.random.default_rng(0).random(len(faces)) < 0.3
    faces[turned] = faces[turned][:, ::-1]
    return plain(letter.vertices, faces)


def folded(letter):
    """Indented beyond the opposite side."""
    vertices = letter.vertices.copy()
    pushed = np.linalg.norm(vertices - vertices[800], axis=1) < 0.03
    vertices[pushed] -= 0.06 * letter.vertex_normals[800]
    return plain(vertices, letter.faces)


SPOILT = {
    f.__name__: f for f in (with_holes, next_to_others, without_shared_vertices, turned_at_random, folded)
}


@pytest.mark.parametrize("name", SPOILT)
def test_spoilt_surfaces_become_bodies(letter, name):
    pytest.importorskip("pymeshlab")
    body = repaired(SPOILT[name](letter), EDGE)
    check_mesh(body)
    assert body.body_count == 1 and body.euler_number == 0 and repair.crossing_faces(body) == 0
    lengths = body.edges_unique_length
    assert np.median(lengths) == pytest.approx(EDGE, rel=0.1) and np.percentile(lengths, 99) < 1.5 * EDGE
    if name != "folded":  # a part of it is gone
        assert body.volume == pytest.approx(letter.volume, rel=5e-3)
        assert volume_iou(body, letter, 64) > 0.95
    angles = np.degrees(trimesh.triangles.angles(body.triangles))
    assert np.percentile(angles.min(axis=1), 5) > 25


def test_same_surface_same_body(letter):
    pytest.importorskip("pymeshlab")
    a, b = (repaired(with_holes(letter), EDGE) for _ in range(2))
    assert np.array_equal(a.vertices, b.vertices) and np.array_equal(a.faces, b.faces)


def test_surfaces_without_an_inside_are_refused(letter):
    pytest.importorskip("pymeshlab")
    with refused("surface") as error:
        repaired(plain([[0, 0, 0], [1, 0, 0], [0, 1, 0]], [[0, 1, 2]]), 0.1, "surface")
    assert "photographs.edge" in error.value.remedy
    with refused("mesh"):
        repaired(plain(np.zeros((0, 3)), np.zeros((0, 3), int)), 0.1)
    broken = letter.copy()
    broken.vertices[7] = np.nan
    with refused("mesh") as error:
        repaired(broken, 0.1)
    assert "vertex 7" in error.value.problem


def test_a_missing_meshlab_is_named(letter, monkeypatch):
    monkeypatch.setitem(sys.modules, "pymeshlab", None)
    with refused("pymeshlab") as error:
        repaired(letter, EDGE)
    assert "make capture" in error.value.remedy
