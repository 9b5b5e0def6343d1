"""Surface from silhouettes, points in volumes: overlap with the truth, counts, evenness, invalid input."""

import dataclasses
import resource

import numpy as np
import pytest
import torch
import trimesh
from PIL import Image
from scipy.spatial import cKDTree

from neuma_lib.config.geometry import SurfaceConfig
from neuma_lib.geometry import shapes, volume
from neuma_lib.geometry.surface import reconstruct
from neuma_lib.geometry.visual_hull import visual_hull
from neuma_lib.geometry.volume import inside, sample_tracers, sample_volume, volume_iou
from neuma_lib.io.images import list_body, load_views, write_transforms
from neuma_lib.splatting.cameras import Cameras
from tests.support.errors import refused
from tests.support.gaussian_sets import some_gaussians
from tests.support.silhouettes import cameras_around, mattes

pytestmark = pytest.mark.core

SURFACE = SurfaceConfig()
SIX = ("ball", "duck", "pawn", "cat", "bottle", "fish")


@pytest.fixture(scope="module")
def bodies():
    return {name: shapes.build(name, 0.35, resolution=40) for name in SIX}


def views_of(mesh, **options):
    """Cameras around a mesh, and their mattes of it."""
    cameras = cameras_around(mesh, **options)
    return cameras, mattes(mesh, cameras)


@pytest.mark.parametrize("name", SIX)
def test_surface_of_six_bodies(bodies, name):
    """50 views of 128 px with the noise of 16 samples a pixel: watertight, one body, volume IoU at least 0.93."""
    truth = bodies[name]
    cameras, images = views_of(truth)
    covered = images[..., 3].numpy()
    images[..., 3] = torch.as_tensor(np.random.default_rng(0).binomial(16, covered) / 16)
    mesh = reconstruct(some_gaussians(truth), cameras, images, SurfaceConfig(resolution=64))
    assert mesh.is_watertight and mesh.volume > 0 and mesh.body_count == 1
    assert volume_iou(mesh, truth, resolution=48) >= 0.93


def test_bodies_of_labelled_images_have_their_volumes(tmp_path):
    """Two balls of 22 px. Without the pixels that they cover by less than half, volumes would be 6 % too small."""
    balls = [trimesh.creation.icosphere(4, 0.1).apply_translation((x, 0.5, 0.5)) for x in (0.35, 0.65)]
    cameras = cameras_around(trimesh.util.concatenate(balls), views=40, size=64)
    alphas = torch.stack([mattes(each, cameras)[..., 3] for each in balls])
    frames = []
    for view in torch.nonzero(~(alphas > 0).all(dim=0).any(dim=(1, 2)))[:, 0].tolist():  # none is hidden
        alpha = 255 * alphas[:, view]
        pixels = torch.cat([torch.full((64, 64, 3), 255.0), alpha.sum(dim=0)[..., None]], dim=-1).byte()
        labels = torch.where(pixels[..., 3] > 127, 1 + alpha.argmax(dim=0), 0).byte()
        for name, image in ((f"{view}.png", pixels), (f"label_{view}.png", labels)):
            Image.fromarray(image.numpy()).save(tmp_path / name)
        pose = np.linalg.inv(cameras.viewmats[view].numpy()) @ np.diag([1.0, -1.0, -1.0, 1.0])
        frame = {"file_path": f"{view}.png", "label_path": f"label_{view}.png", "view": view, "step": 0}
        frames.append({**frame, "transform_matrix": pose.tolist(), "time": 0.0})
    focal = float(cameras.Ks[0, 0, 0])
    lens = {"w": 64, "h": 64, "fl_x": focal, "fl_y": focal, "cx": 32.0, "cy": 32.0}
    write_transforms(tmp_path / "transforms.json", lens, frames)
    for k, truth in enumerate(balls):
        own = tmp_path / str(k) / "transforms.json"
        list_body(tmp_path / "transforms.json", own, 1 + k)
        images, views = load_views(own)
        mesh = reconstruct(some_gaussians(truth), views, images, SURFACE)
        assert mesh.volume == pytest.approx(truth.volume, rel=0.02)


def test_surface_of_a_sphere_is_finer_than_pixels():
    """The radius is found to a tenth of a pixel (here 4 mm)."""
    truth = trimesh.creation.icosphere(4, 0.15)
    cameras, images = views_of(truth, fill=0.6)
    mesh = reconstruct(some_gaussians(truth), cameras, images, SurfaceConfig(resolution=48, smoothing=0))
    pixel = float(0.3 / images[0, ..., 3].sum(1).max())
    radii = np.linalg.norm(mesh.vertices, axis=1)
    assert abs(radii.mean() - 0.15) < 0.1 * pixel
    assert radii.std() < 0.1 * pixel


def test_surface_depends_on_the_gaussians_only_for_the_search(bodies):
    """Floaters outside, or Gaussians on one side of the body only, leave its shape alone."""
    truth = bodies["duck"]
    cameras, images = views_of(truth, views=20, size=64)
    plain = reconstruct(some_gaussians(truth), cameras, images, SURFACE)
    floaters = reconstruct(some_gaussians(truth, outliers=3), cameras, images, SURFACE)
    everything = some_gaussians(truth)
    partial = reconstruct(everything[everything.means[:, 0] > 0.1], cameras, images, SURFACE)
    assert volume_iou(plain, floaters, 48) > 0.98
    assert volume_iou(plain, partial, 48) > 0.98


def test_smoothing_does_not_shrink(bodies):
    truth = bodies["fish"]
    cameras, images = views_of(truth, views=20, size=64)
    rough, smooth = (
        reconstruct(some_gaussians(truth), cameras, images, SurfaceConfig(smoothing=n)) for n in (0, 20)
    )
    assert smooth.area < rough.area
    assert smooth.volume == pytest.approx(rough.volume, rel=2e-3)


def test_nothing_beyond_the_frame_is_in_the_hull():
    """A body that nearly fills small images, a coarse grid: the edge of the frame is near its outline everywhere."""
    ball = trimesh.creation.icosphere(3, 0.13)
    cameras, images = views_of(ball, views=12, size=40, fill=0.98)
    hull = visual_hull(images[..., 3], cameras, 24)
    centres = hull.origin + (hull.occupied.nonzero() + 0.5) * hull.voxel
    # twelve cones touch the ball; between them the hull bulges out by less than 1 / cos(38 degrees)
    assert float(centres.norm(dim=1).max()) < 0.13 / np.cos(np.radians(38)) + hull.voxel


def test_parts_cropped_by_some_frames_are_in_the_hull():
    """A wide hat on a narrow neck: ten of twenty pictures end at the neck, and must not make the hat as narrow."""
    neck = trimesh.creation.cylinder(0.03, 0.2, sections=48)
    hat = trimesh.creation.cylinder(0.1, 0.06, sections=48).apply_translation([0, 0, 0.12])
    truth = trimesh.util.concatenate([neck, hat])
    truth.apply_transform(trimesh.transformations.rotation_matrix(-np.pi / 2, [1, 0, 0]))
    cameras, images = views_of(truth, views=20, size=64)
    whole, cut, views = images[..., 3], [], []
    for k in range(20):
        first = 0
        camera = cameras[k].to("cpu", torch.float64)
        rows = camera.project(torch.tensor([[0.0, 0.06, 0.0]], dtype=torch.float64))[0][0, 0, 1]
        if k % 2 and float(rows) > 4 and not whole[k, int(rows) - 1 :, 0].any():
            first = int(rows)
        Ks = camera.Ks.clone()
        Ks[:, 1, 2] -= first
        views.append(Cameras(camera.viewmats, Ks, camera.width, camera.height - first))
        cut.append(whole[k, first:])
    assert sum(len(mask) < 64 for mask in cut) >= 6
    volumes = []
    for masks, seen in ((list(whole), [cameras[k] for k in range(20)]), (cut, views)):
        hull = visual_hull(masks, seen, 40)
        centres = hull.origin + (hull.occupied.nonzero() + 0.5) * hull.voxel
        volumes.append(float(hull.occupied.sum()) * hull.voxel**3)
        assert float(centres[:, 1].max()) == pytest.approx(0.15, abs=2 * hull.voxel)
        assert float(centres[:, [0, 2]].norm(dim=1).max()) == pytest.approx(0.1, abs=3 * hull.voxel)
    assert volumes[1] == pytest.approx(volumes[0], rel=0.15)


def test_surface_of_two_parts_keeps_the_larger():
    large = trimesh.creation.icosphere(3, 0.1)
    small = trimesh.creation.icosphere(3, 0.03).apply_translation([0.2, 0, 0])
    both = trimesh.util.concatenate([large, small])
    mesh = reconstruct(some_gaussians(both), *views_of(both, views=30, size=64), SURFACE)
    assert mesh.body_count == 1 and volume_iou(mesh, large, 48) > 0.93


def test_same_input_gives_the_same_surface():
    truth = trimesh.creation.box((0.2, 0.1, 0.3))
    views = views_of(truth, views=10, size=48)
    first, second = (
        reconstruct(some_gaussians(truth), *views, SurfaceConfig(resolution=32)) for _ in range(2)
    )
    assert np.array_equal(first.vertices, second.vertices) and np.array_equal(first.faces, second.faces)


@pytest.fixture(scope="module")
def scene():
    truth = trimesh.creation.icosphere(2, 0.1)
    return some_gaussians(truth), *views_of(truth, views=4, size=32)


def test_poses_of_other_images_are_noticed(scene):
    gaussians, cameras, images = scene
    shifted = cameras.viewmats.clone()
    shifted[1, 0, 3] += 0.3
    with refused("masks") as error:
        reconstruct(gaussians, dataclasses.replace(cameras, viewmats=shifted), images, SURFACE)
    assert "inside all masks" in error.value.problem


def test_other_bad_input_of_the_surface_is_named(scene):
    gaussians, cameras, images = scene
    with refused("surface: view 0"):
        reconstruct(gaussians, cameras, images[..., :3], SURFACE)
    with refused("masks: view 0"):
        reconstruct(gaussians, cameras, torch.full_like(images, float("nan")), SURFACE)
    with refused("surface: gaussians"):
        reconstruct(gaussians[:0], cameras, images, SURFACE)
    for view, alpha in ((0, 1.0), (2, 0.0)):
        changed = images.clone()
        changed[view, ..., 3] = alpha
        with refused(f"masks: view {view}"):
            reconstruct(gaussians, cameras, changed, SURFACE)


def test_inside_of_a_torus_is_its_closed_form():
    """Around the hole, where a ray passes two walls; the flat faces may differ from the torus by 1 mm."""
    torus = trimesh.creation.torus(0.2, 0.08, major_sections=96, minor_sections=48)
    points = np.random.default_rng(1).uniform(-0.3, 0.3, (50_000, 3))
    depth = 0.08 - np.hypot(np.hypot(points[:, 0], points[:, 1]) - 0.2, points[:, 2])
    actual = inside(torus, points)
    assert actual[depth > 1e-3].all() and not actual[depth < -1e-3].any()


def test_inside_counts_rays_through_edges_and_corners_once():
    """Points straight below vertices, edges and vertical faces of a box whose lattice they share."""
    box = trimesh.creation.box((2, 2, 2)).subdivide()
    ticks = np.array([-1.5, -1.0, -0.5, 0.0, 0.5, 1.0, 1.5])
    points = np.stack(np.meshgrid(ticks, ticks, ticks, indexing="ij"), axis=-1).reshape(-1, 3)
    actual = inside(box, points)
    clearly_in, clearly_out = (np.abs(points) < 1).all(axis=1), (np.abs(points) > 1).any(axis=1)
    assert actual[clearly_in].all() and not actual[clearly_out].any()


def test_inside_of_a_letter_spares_its_holes():
    """Beyond a cell of the mesh, membership is the sign of the solid's own distance."""
    pytest.importorskip("matplotlib")
    letter = shapes.build("letter_B", 0.3, resolution=48)
    assert letter.euler_number == -2  # two holes
    points = np.random.default_rng(2).uniform(*letter.bounds, (20_000, 3))
    depth, cell = shapes.depth(letter, points), 0.4 / 48
    actual = inside(letter, points)
    assert actual[depth > cell].all() and not actual[depth < -cell].any()


def test_inside_of_overlapping_parts_is_their_union():
    parts = [trimesh.creation.icosphere(3, 0.1).apply_translation([x, 0, 0]) for x in (0.0, 0.1)]
    points = np.array([[0.05, 0, 0], [-0.09, 0, 0], [0.19, 0, 0], [0.0, 0.099, 0.05]])
    assert inside(trimesh.util.concatenate(parts), points).tolist() == [True, True, True, False]


@pytest.mark.parametrize("count", [40, 60_000])
def test_one_point_represents_all_that_no_face_separates(monkeypatch, count):
    """Against the winding number of every point: holes, overlaps, large faces, a leaf, an island in a hollow."""
    ball = trimesh.creation.icosphere(3, radius=0.1)
    hole = trimesh.creation.icosphere(3, radius=0.08)
    hole.invert()
    meshes = {
        "duck": shapes.place("duck", 0.3, 0.3, (0.5, 0.5), 48),
        "torus": trimesh.creation.torus(0.2, 0.08),
        "box": trimesh.creation.box((0.1, 0.2, 0.3)),
        "leaf": trimesh.creation.box((0.3, 0.2, 1e-6)),
        "overlap": trimesh.util.concatenate([ball, ball.copy().apply_translation((0.12, 0.0, 0.0))]),
        "island": trimesh.util.concatenate([ball, hole, trimesh.creation.icosphere(2, radius=0.03)]),
    }
    asked = []
    every = volume._winding_inside
    monkeypatch.setattr(
        volume, "_winding_inside", lambda mesh, points: asked.append(len(points)) or every(mesh, points)
    )
    for name, mesh in meshes.items():
        low, high = mesh.bounds
        points = np.random.default_rng(3).uniform(low - 0.01, high + 0.01, (count, 3))
        points[: count // 2] = np.clip(points[: count // 2], low, high)  # on the bounds, too
        within = ((points >= low) & (points <= high)).all(axis=1)
        expected = within.copy()
        expected[within] = every(mesh, points[within])
        assert (inside(mesh, points) == expected).all(), name
        if count > 1000 and name != "leaf":
            assert asked[-1] < 0.35 * within.sum(), name


@pytest.mark.parametrize("method", ["jittered", "uniform"])
@pytest.mark.parametrize("count", [500, 20_000])
def test_volume_samples_have_the_requested_count_and_lie_inside(bodies, method, count):
    for name, mesh in bodies.items():
        points = sample_volume(mesh, count, seed=3, method=method)
        assert abs(len(points) - count) <= 0.05 * count, name
        assert inside(mesh, points).all(), name


@pytest.mark.parametrize("method", ["jittered", "uniform"])
def test_volume_samples_are_uniform(method):
    """Moments of a box: mean 0 and variance L^2 / 12, within four standard errors of independent points."""
    extents = np.array([0.2, 0.3, 0.1])
    points = sample_volume(trimesh.creation.box(extents), 20_000, seed=4, method=method)
    error = np.sqrt(extents**2 / 12 / len(points))
    assert (np.abs(points.mean(axis=0)) < 4 * error).all()
    assert np.allclose(points.var(axis=0), extents**2 / 12, rtol=4 * np.sqrt(0.8 / len(points)))


def test_jittered_points_fill_more_evenly_than_independent_ones(bodies):
    def holes(method):
        points = sample_volume(bodies["cat"], 5000, seed=5, method=method)
        probes = sample_tracers(bodies["cat"], 20_000, seed=6)
        return np.mean(cKDTree(points).query(probes)[0] ** 2)

    assert holes("jittered") < 0.9 * holes("uniform")


def test_samples_are_repeatable_and_seeds_differ(bodies):
    mesh = bodies["pawn"]
    assert np.array_equal(sample_volume(mesh, 1000, seed=7), sample_volume(mesh, 1000, seed=7))
    assert not np.array_equal(sample_volume(mesh, 1000, seed=7)[:5], sample_volume(mesh, 1000, seed=8)[:5])


def test_tracers_are_a_hundred_thousand(bodies):
    assert len(sample_tracers(bodies["duck"], seed=9)) == pytest.approx(100_000, rel=0.01)


def needle(*sides):
    """A box of these sides along the diagonal of the unit cube."""
    turned = trimesh.geometry.align_vectors([1, 0, 0], [1, 1, 1])
    return trimesh.creation.box(sides).apply_transform(turned)


@pytest.mark.parametrize(
    ("mesh", "method"),
    [
        (needle(1, 1e-5, 1e-5), "jittered"),
        (needle(1, 1e-5, 1e-5), "uniform"),
        (trimesh.creation.box((1, 1e-9, 1e-9)), "jittered"),
    ],
)
def test_a_needle_is_refused_before_its_cells_are_allocated(mesh, method):
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    with refused("mesh", problem="2000 points", remedy="thicker"):
        sample_volume(mesh, 2000, method=method)
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss < before + 100_000  # kB


def test_a_rod_that_fills_a_thousandth_of_its_box_is_sampled():
    mesh = needle(0.5, 0.02, 0.02)
    assert len(sample_volume(mesh, 2000)) == pytest.approx(2000, rel=0.05)


def test_signed_distance_to_overlapping_and_open_parts():
    """Closed form for a ball; the side is right inside an overlap, and next to a hole."""
    ball = trimesh.creation.icosphere(4, radius=0.1)
    points = np.random.default_rng(0).uniform(-0.2, 0.2, (500, 3))
    distance = volume.signed_distance(ball, points)
    np.testing.assert_allclose(distance, np.linalg.norm(points, axis=1) - 0.1, atol=3e-4)
    open_ball = trimesh.Trimesh(ball.vertices, ball.faces[5:], process=False)
    both = trimesh.util.concatenate([open_ball, open_ball.copy().apply_translation([0.05, 0.0, 0.0])])
    radii = np.linalg.norm(points[:, None] - [[0, 0, 0], [0.05, 0, 0]], axis=2).min(axis=1)
    clear = np.abs(radii - 0.1) > 0.01
    assert ((volume.signed_distance(both, points) < 0) == (radii < 0.1))[clear].all()


def test_volume_iou_of_boxes_is_exact():
    a, b = trimesh.creation.box((1, 1, 1)), trimesh.creation.box((1, 1, 1)).apply_translation([0.5, 0, 0])
    assert volume_iou(a, b) == pytest.approx(1 / 3, abs=2e-3)
    assert volume_iou(a, a) == 1.0
    distant = trimesh.creation.box((1, 1, 1)).apply_translation([3.0, 0, 0])
    assert volume_iou(a, distant) == 0.0


def test_open_meshes_are_refused():
    ball = trimesh.creation.icosphere(2, 0.1)
    broken = ball.copy()
    broken.vertices[7] = np.nan
    with refused("mesh") as error:
        sample_volume(broken, 100)
    assert "vertex 7" in error.value.problem
    with refused("mesh") as error:
        sample_volume(trimesh.Trimesh(ball.vertices, ball.faces[1:]), 100)
    assert "watertight" in error.value.problem
    turned = ball.copy()
    turned.invert()
    with refused("first mesh") as error:
        volume_iou(turned, ball)
    assert "inwards" in error.value.problem
    with refused("count"):
        sample_volume(ball, 0)
    with refused("method"):
        sample_volume(ball, 10, method="poisson")
