"""Static reconstruction from photographs: cut out of pictures of any sizes, exposures, bad masks, the floor."""

import dataclasses

import numpy as np
import pytest
import torch
import trimesh
from PIL import Image

from neuma_lib.config.gaussians import DensificationConfig, GaussiansConfig
from neuma_lib.config.geometry import SurfaceConfig
from neuma_lib.config.photographs import PhotographsConfig
from neuma_lib.fitting.gaussians import fit_gaussians
from neuma_lib.geometry.surface import photographed, reconstruct
from neuma_lib.geometry.visual_hull import lacking, visual_hull
from neuma_lib.geometry.volume import check_mesh, inside, sample_volume, volume_iou
from neuma_lib.io.files import read_json, write_json
from neuma_lib.io.images import OPENGL_TO_OPENCV, list_body, write_transforms
from neuma_lib.io.photographs import load_static
from neuma_lib.splatting.cameras import Cameras
from tests.support import raycast
from tests.support.errors import refused
from tests.support.gaussian_sets import some_gaussians
from tests.support.silhouettes import cameras_around, mattes

SIZE, VIEWS = 48, 16
SHORT = GaussiansConfig(
    iterations=200,
    initial_count=400,
    hull_resolution=32,
    held_out=8,
    sh_degree=0,
    densification=DensificationConfig(every=1000),
)


@pytest.fixture(scope="module")
def duck():
    cameras = raycast.sphere_cameras(VIEWS, SIZE)
    return raycast.render(cameras, samples=2), cameras


@pytest.fixture(scope="module")
def plain(duck):
    """Report of a fit to views of one size and exposure."""
    return fit_gaussians(*duck, SHORT, seed=3)[1]


def one_by_one(images, cameras):
    return list(images), list(cameras)


def written(folder, images, cameras, **extra):
    """A transforms.json of images (H, W, 4) in [0, 1] of any sizes."""
    frames = []
    for i, (image, camera) in enumerate(zip(images, cameras)):
        Image.fromarray((255 * image.numpy()).round().astype(np.uint8)).save(folder / f"{i}.png")
        K = camera.Ks[0].tolist()
        lens = {"fl_x": K[0][0], "fl_y": K[1][1], "cx": K[0][2], "cy": K[1][2]}
        pose = np.linalg.inv(camera.viewmats[0].double().numpy()) @ OPENGL_TO_OPENCV
        size = {"w": camera.width, "h": camera.height}
        frames.append({"file_path": f"{i}.png", "transform_matrix": pose.tolist(), **lens, **size})
    write_transforms(folder / "transforms.json", {}, frames, **extra)
    return folder / "transforms.json"


def held_upright(images, cameras):
    """Every second view in a taller frame, whose picture lies elsewhere in it: what a phone held upright gives."""
    results = []
    for i, (image, camera) in enumerate(zip(images, cameras)):
        if i % 2:
            image = torch.nn.functional.pad(image, (0, 0, 3, 0, 15, 8))
            K = camera.Ks + torch.tensor([[0, 0, 3.0], [0, 0, 15.0], [0, 0, 0]])
            camera = Cameras(camera.viewmats, K, image.shape[1], image.shape[0])
        results.append((image, camera))
    return map(list, zip(*results))


# ---- reading


def test_what_is_cut_out_is_seen_by_its_camera_as_before(duck, tmp_path):
    images, cameras = held_upright(*duck)
    path = written(tmp_path, images, cameras, photographs={"floor": None})
    views = load_static(path, PhotographsConfig(margin=0.05))
    points = raycast.CENTRE + 0.05 * torch.randn(20, 3, generator=torch.Generator().manual_seed(0))
    assert len({tuple(image.shape) for image in views.images}) > 2
    for image, camera, whole, before in zip(views.images, views.cameras, images, cameras):
        assert image.shape[1] < SIZE and image.shape[:2] == (camera.height, camera.width)
        shift = (before.project(points)[0] - camera.project(points)[0])[0]
        left, top = shift.mean(0).round().int().tolist()
        assert (shift - torch.tensor([left, top])).abs().max() < 1e-3
        part = whole[top : top + camera.height, left : left + camera.width]
        assert ((image - part).abs()[part[..., 3] > 0] < 0.6 / 255).all()
        # nothing of the object is lost, and its outline is whole
        assert (image[..., 3] > 0.6).sum() == (whole[..., 3] > 0.6).sum()


def test_reduced_mattes_keep_cameras_areas_and_colours(duck, tmp_path):
    """A matte reduced to a third covers a ninth of the pixels, and its camera sees points at its places."""
    images, cameras = duck
    path = written(tmp_path, images[:4], cameras[[0, 1, 2, 3]], photographs={"floor": 0.0})
    whole, small = (load_static(path, PhotographsConfig(longest=n)) for n in (400, 32))
    assert small.floor == 0.0 and small.left_out == ()
    points = raycast.CENTRE + 0.05 * torch.randn(20, 3, generator=torch.Generator().manual_seed(0))
    for a, b, p, q in zip(whole.images, small.images, whole.cameras, small.cameras):
        assert max(b.shape[:2]) <= 32 < max(a.shape[:2])
        factors = torch.tensor([b.shape[1] / a.shape[1], b.shape[0] / a.shape[0]])
        np.testing.assert_allclose(q.project(points)[0], p.project(points)[0] * factors, atol=1e-3)
        np.testing.assert_allclose(b[..., 3].mean(), a[..., 3].mean(), rtol=1e-4)
        mean = [(i[..., :3] * i[..., 3:]).sum((0, 1)) / i[..., 3].sum() for i in (a, b)]
        np.testing.assert_allclose(*mean, rtol=1e-4)


def test_a_body_hidden_by_another_is_not_left_out(duck, tmp_path):
    """In four views another body hides the left of the duck: these pixels stay in the picture, and may be the duck."""
    images, cameras = duck
    source = written(tmp_path, images, cameras, photographs={"floor": None})
    data = read_json(source)
    for k, (frame, image) in enumerate(zip(data["frames"], images)):
        label = (image[..., 3].numpy() > 0.5).astype(np.uint8)
        if k % 4 == 0:
            label[:, : int(np.flatnonzero(label.any(axis=0)).mean())] *= 2
        Image.fromarray(label).save(tmp_path / f"label{k}.png")
        frame["label_path"] = f"label{k}.png"
    write_json(source, data)
    (tmp_path / "own").mkdir()
    list_body(source, tmp_path / "own/transforms.json", 1)
    views = load_static(tmp_path / "own/transforms.json", PhotographsConfig(margin=0.05))
    assert views.left_out == ()
    for k, (image, hidden) in enumerate(zip(views.images, views.hidden, strict=True)):
        visible = image[..., 3] > 0.5
        assert hidden.shape == visible.shape and not (hidden & visible).any()
        assert bool(hidden.any()) == (k % 4 == 0)
        whole = images[k][..., 3] > 0.5
        assert (hidden | visible).sum() == whole.sum()
    others = read_json(tmp_path / "own/transforms.json")
    del others["body"]
    write_json(tmp_path / "own/unknown.json", others)
    left_out = load_static(tmp_path / "own/unknown.json", PhotographsConfig()).left_out
    assert left_out and {*left_out} <= {f"{k}.png" for k in range(0, VIEWS, 4)}


def test_rendered_views_are_read_as_they_are(duck, tmp_path):
    images, cameras = duck
    views = load_static(written(tmp_path, images[:3], cameras[[0, 1, 2]]), PhotographsConfig())
    assert views.images.shape == (3, SIZE, SIZE, 4) and views.photographs is None
    assert views.floor is None and isinstance(views.cameras, Cameras)


def test_bad_sets_of_photographs_are_named(duck, tmp_path):
    images, cameras = duck
    with refused("transforms.json"):
        load_static(
            written(tmp_path, images[:3], cameras[[0, 1, 2]], photographs={"floor": None}),
            PhotographsConfig(),
        )
    for entry in (True, {}, {"floor": "low"}, {"floor": float("inf")}, {"floor": 0.0, "gain": 1}):
        # A number beyond the range of floats is refused by the reader of JSON.
        infinite = "inf" in str(entry)
        with refused("transforms.json" if infinite else "transforms.json: photographs"):
            written(tmp_path, images[:4], cameras[[0, 1, 2, 3]])
            text = (tmp_path / "transforms.json").read_text()
            entry_text = str(entry).replace("'", '"').replace("True", "true").replace("inf", "1e999")
            (tmp_path / "transforms.json").write_text(
                text.replace("{", f'{{"photographs": {entry_text}, ', 1)
            )
            load_static(tmp_path / "transforms.json", PhotographsConfig())
    empty = images[:4].clone()
    empty[2, ..., 3] = 0
    with refused("2.png"):
        load_static(
            written(tmp_path, empty, cameras[[0, 1, 2, 3]], photographs={"floor": None}), PhotographsConfig()
        )


# ---- Gaussians


def test_views_one_by_one_are_the_same_views(duck):
    """To the bit, where a step takes one of them."""
    settings = SHORT.model_copy(update=dict(iterations=15))
    (a, first), (b, second) = (fit_gaussians(*views, settings, seed=5) for views in (duck, one_by_one(*duck)))
    for field in dataclasses.fields(a):
        assert torch.equal(getattr(a, field.name), getattr(b, field.name))
    assert first == second and first.gains is None


def test_a_step_over_views_of_several_sizes_is_their_mean(duck):
    """Two views in a step, one by one or together: gradients are summed, so only rounding differs."""
    settings = SHORT.model_copy(update=dict(iterations=3, batch=2))
    first, second = (fit_gaussians(*views, settings, seed=5)[1].losses for views in (duck, one_by_one(*duck)))
    np.testing.assert_allclose(first, second, rtol=1e-4)


def test_exposures_that_were_put_in_are_recovered(duck, plain):
    """Down to half as bright, independently per channel: less than a third remains, and held-out views are as good.

    What is left is shading that few Gaussians draw coarsely: the views from above are the brighter ones.
    """
    images, cameras = duck
    put_in = torch.exp(0.7 * (torch.rand(VIEWS, 3, generator=torch.Generator().manual_seed(1)) - 1.0))
    exposed = images.clone()
    exposed[..., :3] *= put_in[:, None, None]
    blind, result = (
        fit_gaussians(exposed, cameras, SHORT, seed=3, gain_rate=rate)[1] for rate in (0.0, 0.02)
    )
    fitted = [i for i in range(VIEWS) if i not in result.held_out]
    spread = put_in.log() - put_in[fitted].log().mean(0)
    gains = torch.tensor(result.gains).log()
    for views in (fitted, result.held_out):
        assert (gains - spread)[views].square().mean().sqrt() < spread[views].square().mean().sqrt() / 3
    assert gains[fitted].mean(0).abs().max() < 1e-5
    assert result.train_psnr_object > blind.train_psnr_object + 1.5
    assert result.psnr_object > plain.psnr_object - 0.5


def test_upright_and_across_fit_as_one_size_does(duck, plain, tmp_path):
    path = written(tmp_path, *held_upright(*duck), photographs={"floor": None})
    views = load_static(path, PhotographsConfig())
    _, mixed = fit_gaussians(views.images, views.cameras, SHORT, seed=3, floor=views.floor)
    # another start in another hull, and less of the white around the object in the loss
    assert mixed.psnr_object > plain.psnr_object - 1


def test_wrong_sizes_of_single_views_are_refused(duck):
    images, cameras = one_by_one(*duck)
    with refused("images"):
        fit_gaussians([images[0][:32], *images[1:]], cameras, SHORT)
    with refused("surface: view 1"):
        reconstruct(some_gaussians(BALL), cameras, [images[0], images[1][:32], *images[2:]], SurfaceConfig())


# ---- hull and surface

BALL = trimesh.creation.icosphere(3, 0.1)


def spoilt(images):
    """Of one mask a half is missing, another is of another pose."""
    images = images.clone()
    images[3, :, : images.shape[2] // 2] = 0
    images[7] = torch.roll(images[7], 12, dims=1)
    return images


def test_masks_are_scored_by_what_nearly_all_hold():
    """Good masks lack little of the body, bad ones much, although the intersection of all is half as large."""
    cameras = cameras_around(BALL, views=20, size=48)
    images = mattes(BALL, cameras)
    good, bad = images[..., 3], spoilt(images)[..., 3]
    whole, carved = (visual_hull(masks, cameras, 24) for masks in (good, bad))
    assert carved.occupied.sum() * carved.voxel**3 < 0.6 * whole.occupied.sum() * whole.voxel**3
    shares = lacking(bad, cameras, 0.9)
    most = PhotographsConfig().lacking
    assert (shares > 1.5 * most).nonzero()[:, 0].tolist() == [3, 7]
    assert shares.sort().values[-3] < most / 1.5 and lacking(good, cameras, 0.9).max() < most / 1.5


def test_photographs_with_spoilt_masks_are_left_out(tmp_path):
    """The surface is then that of the good masks; where many are bad, a message gives a remedy."""
    ball = BALL.copy().apply_translation([0.5, 0.1, 0.5])
    cameras = cameras_around(ball, views=20, size=48)
    images = mattes(ball, cameras)
    path = written(tmp_path, spoilt(images), list(cameras), photographs={"floor": 0.0})
    views = load_static(path, PhotographsConfig())
    assert views.left_out == ("3.png", "7.png") and len(views.images) == len(views.cameras) == 18
    settings = SurfaceConfig(resolution=24)
    mesh = reconstruct(some_gaussians(ball), views.cameras, views.images, settings, views.floor)
    assert volume_iou(mesh, ball, 48) > 0.9
    assert load_static(path, PhotographsConfig(lacking=1)).left_out == ()
    with refused(path):
        load_static(path, PhotographsConfig(lacking=1e-9))


def test_the_floor_bounds_what_no_camera_sees():
    """A box seen from above alone: its hull has a root without the floor, and is cut off by it."""
    box = trimesh.creation.box((0.2, 0.1, 0.2)).apply_translation([0.5, 0.05, 0.5])
    everywhere = cameras_around(box, views=50, size=48)
    above = [i for i, eye in enumerate(everywhere.positions) if eye[1] > 0.3]
    cameras = everywhere[above]
    images, settings = mattes(box, cameras), SurfaceConfig(resolution=32, smoothing=0)
    rooted, standing = (
        reconstruct(some_gaussians(box), cameras, images, settings, floor) for floor in (None, 0.0)
    )
    assert rooted.bounds[0, 1] < -0.01
    assert rooted.volume > 1.05 * standing.volume and 0 <= standing.bounds[0, 1] < 1e-3
    points = np.random.default_rng(0).uniform(*rooted.bounds, (5000, 3))
    assert (inside(standing, points) == (inside(rooted, points) & (points[:, 1] > 0))).mean() > 0.99
    hull = visual_hull(images[..., 3], cameras, 32, 0.0)
    assert (
        float(hull.origin[1] + 0.5 * hull.voxel + hull.occupied.nonzero()[:, 1].min() * hull.voxel)
        > -hull.voxel
    )


def test_a_photographed_body_is_closed_even_and_holds_particles():
    pytest.importorskip("pymeshlab")
    box = trimesh.creation.box((0.2, 0.1, 0.2)).apply_translation([0.5, 0.05, 0.5])
    cameras = cameras_around(box, views=20, size=48)
    mesh = reconstruct(some_gaussians(box), cameras, mattes(box, cameras), SurfaceConfig(resolution=32), 0.0)
    body = photographed(mesh, 0.05, 0.0)
    check_mesh(body)
    assert body.bounds[0, 1] >= 0 and body.volume == pytest.approx(mesh.volume, rel=0.02)
    assert np.median(body.edges_unique_length) == pytest.approx(0.05 * mesh.extents.max(), rel=0.1)
    points = sample_volume(body, 1000)
    assert abs(len(points) - 1000) <= 50 and inside(mesh, points).mean() > 0.98
    for move in ([0.6, 0, 0], [0, 0, -0.5]):
        with refused("surface"):
            photographed(mesh.copy().apply_translation(move), 0.05, None)
