"""Videos in the layouts of PAC-NeRF and Spring-Gaus: cameras, masks, frames, placement, mistakes."""

import json
from pathlib import Path

import numpy as np
import pytest
import yaml
from PIL import Image

from neuma_lib.config.scenes import SuppliedConfig
from neuma_lib.errors import InputError
from neuma_lib.io.datasets.layouts import OFFSETS, take_video
from neuma_lib.io.files import read_json
from neuma_lib.io.images import list_images, load_observation
from neuma_lib.project.loading import load
from tests.support.errors import refused
from tests.support.image_layouts import (
    HEIGHT,
    RADIUS,
    SIZE,
    WIDTH,
    WRITERS,
    K,
    centre_of,
    ours,
    poses_of,
    write_pac_nerf,
    write_spring_gaus,
)
from workflow.inputs import COUNTED, image_list

ROOT = Path(__file__).resolve().parents[2]
STRIDE = 10


@pytest.mark.parametrize("kind", WRITERS)
@pytest.mark.parametrize("world", [{}, {"scale": 0.8, "offset": [0.4, 0.1, 0.55]}])
def test_known_points_are_seen_where_their_cameras_see_them(tmp_path, kind, world):
    source, _ = WRITERS[kind](tmp_path / "set")
    images = take_video(source, tmp_path / "ours/transforms.json", [0, 20, 30], STRIDE, **world)
    assert images.views.tolist() == [0, 1, 2] * 3 and images.steps.tolist() == [0] * 3 + [20] * 3 + [30] * 3
    points = centre_of(kind, 1) + np.random.default_rng(1).uniform(-0.3, 0.3, (20, 3))
    for view, viewmat, intrinsics in zip(images.views, images.viewmats, images.Ks, strict=True):
        pose = poses_of(kind, 3)[view]
        x, y, z = ((points - pose[:, 3]) @ pose[:, :3]).T  # OpenGL: it looks along -z, y is up in the image
        seen = np.stack([K[0][2] + K[0][0] * x / -z, K[1][2] - K[1][1] * y / -z], axis=1)
        local = ours(kind, points, **world) @ viewmat[:3, :3].T + viewmat[:3, 3]
        projected = local @ intrinsics.T
        np.testing.assert_allclose(projected[:, :2] / projected[:, 2:], seen, rtol=0, atol=1e-9)
    placed = {"scale": world.get("scale", 1.0), "offset": list(world.get("offset") or OFFSETS[source.name])}
    assert read_json(tmp_path / "ours/transforms.json").get("world") == placed


@pytest.mark.parametrize("kind", WRITERS)
def test_rays_through_loaded_pixels_meet_the_placed_body_where_the_mask_is(tmp_path, kind):
    """The way back, through our own conventions (OpenCV axes, pixel centres at +0.5)."""
    source, _ = WRITERS[kind](tmp_path / "set")
    images = take_video(source, tmp_path / "ours/transforms.json", [0, 30], STRIDE)
    u, v = np.meshgrid(np.arange(WIDTH) + 0.5, np.arange(HEIGHT) + 0.5)
    pixels = np.stack([u, v, np.ones_like(u)], axis=-1)
    for k, image in enumerate(images.images):
        rays = pixels @ np.linalg.inv(images.Ks[k]).T @ images.viewmats[k][:3, :3]
        eye = -images.viewmats[k][:3, :3].T @ images.viewmats[k][:3, 3]
        away = eye - ours(kind, centre_of(kind, images.steps[k] / STRIDE))
        b, a = rays @ away, (rays**2).sum(axis=-1)
        np.testing.assert_array_equal(image[..., 3] > 0, b**2 > a * ((away**2).sum() - RADIUS**2))


@pytest.mark.parametrize("form", ["matted", "background", "alpha"])
def test_images_of_pac_nerf_keep_their_colours_and_get_their_mask(tmp_path, form):
    source, truth = write_pac_nerf(tmp_path / "set", form=form)
    target = tmp_path / "ours/transforms.json"
    images = take_video(source, target, [0, 10, 20, 30], STRIDE)
    for image, view, step in zip(images.images, images.views, images.steps, strict=True):
        np.testing.assert_array_equal(image, truth[view, step // STRIDE])
    written = {file.name for file in target.parent.iterdir()}
    assert written == {"transforms.json"} if form == "alpha" else len(written) == 13


def test_white_in_the_object_differs_from_a_coloured_background(tmp_path):
    source, truth = write_pac_nerf(tmp_path / "set", cameras=2, frames=1, form="background")
    file = tmp_path / "set/data/r_0_0.png"
    pixels = truth[0, 0][..., :3].copy()
    row, column = np.argwhere(truth[0, 0][..., 3] > 0).mean(axis=0).astype(int)
    pixels[row, column] = 255
    Image.fromarray(pixels).save(file)
    images = take_video(source, tmp_path / "ours/transforms.json", [0], STRIDE)
    assert (images.images[0][row, column] == 255).all()


def test_images_of_spring_gaus_stay_where_they_are(tmp_path):
    source, truth = write_spring_gaus(tmp_path / "set")
    target = tmp_path / "ours/transforms.json"
    images = take_video(source, target, [0, 10, 20, 30], STRIDE)
    assert [file.name for file in target.parent.iterdir()] == ["transforms.json"]
    for image, view, step in zip(images.images, images.views, images.steps, strict=True):
        np.testing.assert_array_equal(image, truth[view, step // STRIDE])


@pytest.mark.parametrize("kind", WRITERS)
def test_a_part_of_a_video_and_its_first_frames_are_taken(tmp_path, kind):
    source, _ = WRITERS[kind](tmp_path / "set")
    static = take_video(source, tmp_path / "static/transforms.json", [0], STRIDE)
    assert static.views.tolist() == [0, 1, 2] and not static.steps.any()
    take_video(source, tmp_path / "dynamic/transforms.json", [0, 20], STRIDE)
    video = load_observation(tmp_path / "dynamic/transforms.json", views=[1, 2])
    assert video.frames == (0, 20) and video.images.shape == (2, 2, HEIGHT, WIDTH, 4)


def edit(path, change):
    entries = json.loads(path.read_text())
    change(entries)
    path.write_text(json.dumps(entries))


PAC_MISTAKES = [
    (lambda e: e[1].pop("file_path"), "all_data.json: entry 1"),
    (lambda e: e[1].update(file_path="data/first.png"), "entry 1 (data/first.png): file_path"),
    (lambda e: e.append(e[1]), "entry 10 (data/r_0_0.png): file_path"),
    (lambda e: e[1].pop("c2w"), "entry 1 (data/r_0_0.png): c2w"),
    (lambda e: e[1].update(intrinsic=[1]), "intrinsic"),
    (lambda e: e[3]["c2w"][0].__setitem__(3, 9.0), "camera 0"),
    (lambda e: e.pop(7), "all_data.json"),
    (lambda e: [x["c2w"][0].__setitem__(0, 5.0) for x in e[:5]], "transform_matrix"),
    (lambda e: e.clear(), "all_data.json"),
]
SPRING_MISTAKES = [
    (lambda e: e[1].pop("camera"), "camera.json: entry 1: camera"),
    (lambda e: e[1].pop("K"), "entry 1 (camera_01): K"),
    (lambda e: e[1]["K"][0].__setitem__(1, 1.0), "entry 1 (camera_01): K"),  # skew
    (lambda e: e[1].update(camera="nowhere"), "nowhere/000.png"),
]


@pytest.mark.parametrize(
    ("kind", "change", "where"),
    [("pac_nerf", *case) for case in PAC_MISTAKES] + [("spring_gaus", *case) for case in SPRING_MISTAKES],
)
def test_mistakes_are_named(tmp_path, kind, change, where):
    source, _ = WRITERS[kind](tmp_path / "set", cameras=2)
    edit(source, change)
    with refused(where):
        take_video(source, tmp_path / "ours/transforms.json", [0, 10, 20, 30], STRIDE)


def test_images_without_any_mask_and_occluders_are_refused(tmp_path):
    source, _ = write_pac_nerf(tmp_path / "set", cameras=2, form="background")
    with_backgrounds = source.read_text()
    edit(source, lambda e: [e.remove(x) for x in list(e) if x["file_path"].endswith("_-1.png")])
    target = tmp_path / "ours/transforms.json"
    with refused("r_0_0.png", remedy="m_0_0.png"):
        take_video(source, target, [0], STRIDE)
    source.write_text(with_backgrounds)
    edit(source, lambda e: e.append({**e[0], "file_path": "data/r_0_-2.png"}))
    occluder = tmp_path / "set/data/r_0_-2.png"
    Image.new("RGBA", SIZE, (0, 0, 0, 0)).save(occluder)
    take_video(source, target, [0], STRIDE)
    Image.new("RGBA", SIZE, (0, 0, 0, 255)).save(occluder)
    with refused("r_0_-2.png"):
        take_video(source, target, [0], STRIDE)


def test_cameras_that_look_past_the_box_are_refused(tmp_path):
    source, _ = write_pac_nerf(tmp_path / "set")
    with refused("all_data.json", problem="(-1.00, 0.50, 0.00) m", remedy="images.offset"):
        take_video(source, tmp_path / "ours/transforms.json", [0], STRIDE, offset=[-1.0, 0.0, 0.0])


def test_our_own_lists_are_placed_too(tmp_path):
    source, target = tmp_path / "a/transforms.json", tmp_path / "b/transforms.json"
    before = take_video(write_pac_nerf(tmp_path / "set")[0], source, [0], STRIDE, offset=[0.2, 0, 0.3])
    moved = list_images(source, target, 2.0, [0.1, 0.2, 0.3])
    point = np.array([0.3, 0.4, 0.2, 1.0])
    there = np.array([*(2.0 * point[:3] + [0.1, 0.2, 0.3]), 1.0])
    expected = 2.0 * (before.viewmats @ point)[:, :3]
    np.testing.assert_allclose((moved.viewmats @ there)[:, :3], expected, atol=1e-12)


def test_settings_name_the_folder_or_the_file(tmp_path):
    source, _ = write_spring_gaus(tmp_path / "set", cameras=1, frames=1)
    for place in (source, source.parent, f"{source.parent}/"):
        assert image_list(str(place), 5, "a", "b") == str(source)
    with pytest.raises(InputError, match="b: missing, but .* numbers frames"):
        image_list(str(source), None, "a", "b")
    with pytest.raises(InputError, match="a: the folder .* has none of"):
        image_list(str(tmp_path), 5, "a", "b")
    assert image_list("release/list.json", None, "a", "b") == "release/list.json"
    assert set(COUNTED) == set(OFFSETS)


def test_frames_of_a_scene_are_those_that_the_folder_counts():
    def frames(**own):
        scene = {"images": {"stride": 100}, "steps": 450} | own
        raw = yaml.safe_load((ROOT / "config/config.yaml").read_text())
        return load(raw | {"scenes": {"BouncyBall": scene}}).frame_steps("BouncyBall")

    assert frames() == (0, 100, 200, 300, 400)
    assert frames(frames=[0, 200]) == (0, 200)
    with pytest.raises(InputError, match=r"frames: step 150 is not a multiple of images\.stride = 100"):
        frames(frames=[0, 150])
    assert SuppliedConfig().offset is None
