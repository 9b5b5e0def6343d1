"""Images in the layout of the authors' release."""

import json

import numpy as np
import pytest
import torch

from neuma_lib.io.images import list_images, load_observation, read_image_set
from tests.support.errors import refused
from tests.support.released_images import K, write_release


def test_release_is_read(tmp_path):
    images = read_image_set(write_release(tmp_path))
    assert images.images.shape == (6, 30, 32, 4)
    assert images.views.tolist() == [0, 0, 0, 2, 2, 2] and images.steps.tolist() == [0, 2, 4] * 2
    assert (images.images[:, 0, 0, :2] == np.stack([images.views, images.steps], axis=1)).all()
    np.testing.assert_allclose(images.Ks, np.tile(K, (6, 1, 1)))
    # One metre in front of an OpenGL camera (its -z) is one metre along +z of the OpenCV camera.
    np.testing.assert_allclose(images.viewmats[3] @ [0.5, 0.6, 1.0, 1.0], [0, 0, 1, 1], atol=1e-12)


def test_release_is_a_video(tmp_path):
    video = load_observation(write_release(tmp_path), views=[2])
    assert video.frames == (0, 2, 4) and video.images.shape == (3, 1, 30, 32, 4)
    assert video.images.dtype == torch.uint8


def test_names_without_view_and_step_are_views_at_the_start(tmp_path):
    path = write_release(tmp_path)
    entries = json.loads(path.read_text())[:3]
    for i, entry in enumerate(entries):
        renamed = tmp_path / f"image{i}.png"
        (tmp_path / entry["file_path"]).rename(renamed)
        entry |= {"file_path": renamed.name, "c2w": entry["c2w"][:3]}
    path.write_text(json.dumps(entries))
    images = read_image_set(path)
    assert images.views.tolist() == [0, 1, 2] and images.steps.tolist() == [0, 0, 0]


@pytest.mark.parametrize(
    ("change", "where"),
    [
        (lambda e: e.pop("file_path"), "data_dynamic.json: entry 1"),
        (lambda e: e.pop("c2w"), "d_0_002.png): c2w"),
        (lambda e: e.update(c2w=[[1, 2]]), "c2w"),
        (lambda e: e.update(intrinsic=[["a"] * 3] * 3), "intrinsic"),
        (lambda e: e.update(intrinsic=[[40, 1, 16], [0, 41, 15], [0, 0, 1]]), "intrinsic"),
        (lambda e: e.update(intrinsic=[[-4, 0, 16], [0, 41, 15], [0, 0, 1]]), "fl_x"),
        (lambda e: e.update(c2w=(2 * np.eye(4)).tolist()), "transform_matrix"),
        (lambda e: e.update(file_path="./d_0_009.png"), "d_0_009.png"),
    ],
)
def test_mistakes_are_named(tmp_path, change, where):
    path = write_release(tmp_path)
    entries = json.loads(path.read_text())
    change(entries[1])
    path.write_text(json.dumps(entries))
    with refused(where):
        read_image_set(path)


def test_listed_images_stay_where_they_are(tmp_path):
    source = write_release(tmp_path / "release")
    listed = tmp_path / "project" / "data" / "scene" / "dynamic" / "transforms.json"
    list_images(source, listed)
    assert [f.name for f in listed.parent.iterdir()] == ["transforms.json"]
    ours, theirs = read_image_set(listed), read_image_set(source)
    assert (ours.images == theirs.images).all() and (ours.viewmats == theirs.viewmats).all()
    assert (ours.Ks == theirs.Ks).all() and (ours.steps == theirs.steps).all()
    image = tmp_path / "release/data_dynamic/d_0_000.png"
    image.write_bytes(image.read_bytes() + b"\0")
    with refused("d_0_000.png"):
        read_image_set(listed)
