"""Repair of surfaces: the result is one closed body of even triangles, or an error."""

import sys

import numpy as np
import pytest
import trimesh

from neuma_lib.geometry import repair, shapes
from neuma_lib.geometry.repair import repaired
from neuma_lib.geometry.solid_body import solid_body
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


def inverted(letter):
    return plain(letter.vertices, letter.faces[:, ::-1])


def doubled(letter):
    """Every face twice, once degenerate faces are among them."""
    corner = np.repeat(letter.faces[:50, :1], 3, axis=1)
    return plain(letter.vertices, np.concatenate([letter.faces, letter.faces, corner]))


DONE = {
    with_holes: "closed holes",
    turned_at_random: "coherently",
    without_shared_vertices: "meshed",
    next_to_others: "largest, which has 9",
    inverted: "outwards",
    doubled: "duplicate or degenerate",
}


@pytest.mark.parametrize("spoil", DONE, ids=lambda spoil: spoil.__name__)
def test_any_mesh_becomes_a_solid_body_and_what_was_done_is_listed(letter, spoil):
    pytest.importorskip("pymeshlab")
    body, done = solid_body(spoil(letter), resolution=48)
    check_mesh(body)
    assert body.body_count == 1
    assert any(DONE[spoil] in step for step in done), done
    # half a cell at each end of a bar of the letter, which is 9 cells wide
    assert body.volume == pytest.approx(letter.volume, rel=0.1)
    assert volume_iou(body, letter.copy().apply_translation(-letter.bounds.mean(axis=0)), 64) > 0.9


def test_a_closed_solid_of_overlapping_parts_needs_no_meshlab(monkeypatch):
    """Two balls that overlap are one body, in any unit and far from the origin; the cavity in one is filled."""
    monkeypatch.setitem(sys.modules, "pymeshlab", None)
    ball, hole = (trimesh.creation.icosphere(3, radius) for radius in (100.0, 30.0))
    hole.invert()
    parts = [ball, hole, ball.copy().apply_translation([150.0, 0, 0])]
    mesh = trimesh.util.concatenate(parts).apply_translation([1e5, 0, 0])
    body, done = solid_body(mesh)
    lens = np.pi * (2 * 100 - 150) ** 2 * (150**2 + 4 * 150 * 100) / (12 * 150)  # intersection of the balls
    assert body.volume == pytest.approx(2 * 4 / 3 * np.pi * 100**3 - lens, rel=0.02)
    np.testing.assert_allclose(body.extents, [350, 200, 200], rtol=0.01)
    np.testing.assert_allclose(body.bounds.mean(axis=0), 0.0, atol=1e-6)
    assert body.body_count == 1 and len(done) == 2


@pytest.mark.parametrize(
    ("mesh", "problem"),
    [
        (plain([[0, 0, 0], [1, 0, 0], [0, 1, 0]], [[0, 1, 2]]), "encloses no space"),
        (trimesh.creation.box((1, 1e-4, 1e-4)), "encloses no space"),
        (plain(np.random.default_rng(0).random((9000, 3)), np.arange(9000).reshape(-1, 3)), "area"),
    ],
    ids=["sheet", "needle", "soup"],
)
def test_what_encloses_nothing_is_refused_as_a_solid(mesh, problem):
    pytest.importorskip("pymeshlab")
    with refused("cup.obj", problem=problem):
        solid_body(mesh, "cup.obj")
