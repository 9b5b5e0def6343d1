"""Solids of the benchmarks, and their meshes carried by particles."""

from importlib.util import find_spec

import numpy as np
import pytest
import trimesh
from scipy import ndimage
from scipy.spatial.transform import Rotation

from neuma_lib.geometry import shapes
from neuma_lib.geometry.skinning import carry, skinning_matrix
from tests.support.errors import refused

pytestmark = pytest.mark.core

NEEDS_FONT = pytest.mark.skipif(find_spec("matplotlib") is None, reason="the font of letters is matplotlib's")
SOLIDS = (*shapes.NAMES, *(pytest.param(f"letter_{c}", marks=NEEDS_FONT) for c in "NB"))


@pytest.mark.parametrize("name", SOLIDS)
def test_solid_is_one_closed_body_of_the_requested_size(name):
    mesh = shapes.build(name, size=0.3, resolution=48)
    assert mesh.is_watertight and mesh.is_winding_consistent
    assert mesh.body_count == 1
    assert mesh.volume > 0.0
    np.testing.assert_allclose(mesh.extents.max(), 0.3, rtol=1e-9)
    np.testing.assert_allclose(mesh.bounds.mean(axis=0), 0.0, atol=1e-9)


@pytest.mark.parametrize("name", shapes.NAMES)
def test_every_part_shows_on_the_surface(name):
    mesh = shapes.build(name, resolution=80)
    solid = shapes.shape(name)
    weights = solid.part_weights(shapes.to_nominal(mesh, mesh.vertices)[1], softness=0.005)
    np.testing.assert_allclose(weights.sum(axis=1), 1.0, atol=1e-12)
    largest = dict(zip(solid.part_names, weights.max(axis=0), strict=True))
    assert min(largest.values()) > 0.5, largest


@pytest.mark.parametrize("name", shapes.NAMES)
def test_little_of_a_solid_is_too_thin_for_the_grid(name):
    """An opening with a ball of 4 cm diameter, one cell of the default grid, keeps nearly the whole solid."""
    mesh = shapes.build(name, resolution=64)
    cell = 0.005
    axes = [np.arange(lo - 0.04, hi + 0.04, cell) for lo, hi in mesh.bounds.T]
    points = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
    inside = (shapes.depth(mesh, points.reshape(-1, 3)) > 0).reshape(points.shape[:3])
    core = ndimage.distance_transform_edt(inside) * cell > 0.02
    opened = ndimage.distance_transform_edt(~core) * cell <= 0.02
    assert (opened & inside).sum() > 0.93 * inside.sum()


def test_ball_has_the_volume_of_a_ball_and_depth_is_distance():
    mesh = shapes.build("ball", size=0.26, resolution=64)
    np.testing.assert_allclose(mesh.volume, 4 / 3 * np.pi * 0.13**3, rtol=2e-3)
    points = np.random.default_rng(0).uniform(-0.1, 0.1, (50, 3))
    np.testing.assert_allclose(shapes.depth(mesh, points), 0.13 - np.linalg.norm(points, axis=1), atol=1e-3)


def test_placed_solid_keeps_its_parts():
    rest, placed = shapes.build("duck", 0.3, 40), shapes.place("duck", 0.3, 0.42, (0.4, 0.6), 40)
    np.testing.assert_allclose(placed.bounds.mean(axis=0), [0.4, 0.42, 0.6], atol=1e-9)
    np.testing.assert_allclose(
        shapes.to_nominal(placed, placed.vertices)[1], shapes.to_nominal(rest, rest.vertices)[1], atol=1e-9
    )


def test_a_mesh_is_a_solid_with_one_part():
    """Size and place as of a built-in shape; its depth is the closed form within the sagitta of a triangle."""
    ball = trimesh.creation.icosphere(4, 20.0).apply_translation([7.0, -3.0, 50.0])
    placed = shapes.place(ball, 0.3, 0.42, (0.4, 0.6))
    np.testing.assert_allclose(placed.bounds.mean(axis=0), [0.4, 0.42, 0.6], atol=1e-9)
    np.testing.assert_allclose(placed.extents.max(), 0.3, rtol=1e-9)
    centre = np.array([0.4, 0.42, 0.6])
    points = centre + np.random.default_rng(0).uniform(-0.1, 0.1, (100, 3))
    radius = np.linalg.norm(points - centre, axis=1)
    edge = placed.edges_unique_length.max()
    # the nearest vertex is at most an edge from the nearest point: the plane there is farther by edge^2 / 2 R
    bound = edge**2 / 0.3 + radius * (edge / 0.15) ** 2 / 2
    assert (np.abs(shapes.depth(placed, points) - (0.15 - radius)) < bound).all()
    solid, nominal = shapes.to_nominal(placed, points)
    assert solid.part_names == ("body",)
    np.testing.assert_allclose(nominal, ball.bounds.mean(axis=0) + (points - centre) * 40 / 0.3, atol=1e-6)
    np.testing.assert_allclose(shapes.build(ball).extents, ball.extents)  # in metres without a size
    with refused("size"):
        shapes.build(ball, size=-1.0)


def test_wrong_names_and_sizes_are_named():
    with refused("shape") as error:
        shapes.build("dukc")
    assert "'duck'" in error.value.problem
    with refused("size"):
        shapes.build("duck", size=-1.0)
    with refused("resolution"):
        shapes.build("duck", resolution=2)


def test_skinning_reproduces_affine_motion():
    rng = np.random.default_rng(1)
    mesh = shapes.build("cat", 0.3, 40)
    particles = rng.uniform(mesh.bounds[0], mesh.bounds[1], (20000, 3))
    particles = particles[shapes.depth(mesh, particles) > 0]
    matrix = skinning_matrix(mesh.vertices, particles)
    np.testing.assert_allclose(np.asarray(matrix.sum(axis=1)).ravel(), 1.0, atol=1e-9)
    affine, shift = np.eye(3) + 0.3 * rng.standard_normal((3, 3)), rng.standard_normal(3)
    moved = carry(matrix, np.stack([particles, particles @ affine.T + shift]))
    np.testing.assert_allclose(moved[0], mesh.vertices, atol=1e-9)
    np.testing.assert_allclose(moved[1], mesh.vertices @ affine.T + shift, atol=1e-9)


def test_skinning_follows_a_bend():
    """A quadratic motion is followed to second order in the particles' spacing."""
    rng = np.random.default_rng(2)
    mesh = shapes.build("bottle", 0.4, 40)
    particles = rng.uniform(mesh.bounds[0], mesh.bounds[1], (20000, 3))
    particles = particles[shapes.depth(mesh, particles) > 0]

    def bend(p):
        return p + np.stack([1.5 * p[:, 1] ** 2, 0 * p[:, 0], 0 * p[:, 0]], axis=1)

    moved = carry(skinning_matrix(mesh.vertices, particles), bend(particles)[None])[0]
    spacing = (mesh.volume / len(particles)) ** (1 / 3)
    # The fit reaches about 2.5 spacings; its error is at most the curvature (1.5) times that squared.
    assert np.abs(moved - bend(np.asarray(mesh.vertices))).max() < 1.5 * (2.5 * spacing) ** 2


def test_skinning_needs_particles():
    with refused("skinning: particles"):
        skinning_matrix(np.zeros((3, 3)), np.zeros((4, 3)))


def test_a_turned_solid_is_placed_and_keeps_its_parts():
    """Its bounding box is centred as before, its volume is the same, and each vertex belongs to the same part."""
    rotation = (0.4, -1.1, 0.7)
    rest = shapes.place("duck", 0.3, 0.42, (0.4, 0.6), 40)
    turned = shapes.place("duck", 0.3, 0.42, (0.4, 0.6), 40, rotation)
    assert turned.bounds.mean(axis=0) == pytest.approx([0.4, 0.42, 0.6])
    assert turned.volume == pytest.approx(rest.volume)
    R = Rotation.from_rotvec(rotation).as_matrix()
    edges = [mesh.vertices[1:] - mesh.vertices[:1] for mesh in (rest, turned)]
    assert edges[1] == pytest.approx(edges[0] @ R.T)
    nominal = [shapes.to_nominal(mesh, mesh.vertices)[1] for mesh in (rest, turned)]
    assert nominal[1] == pytest.approx(nominal[0], abs=1e-9)
