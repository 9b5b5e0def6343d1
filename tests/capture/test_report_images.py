"""Measures of predicted pictures of a real take compared with its video."""

import numpy as np
import pytest
import torch

from neuma_lib.capture.report.images import (
    COLUMNS,
    averaged,
    captured_metrics,
    composited,
    error_picture,
    exposed,
    image_rows,
    images_csv,
)
from neuma_lib.evaluation.image_metrics import object_window, psnr, ssim
from tests.support.errors import refused

SIDE = 64


@pytest.fixture
def scene():
    """A disc as filmed in front of noise, and a prediction of it that is 3 pixels off."""
    rng = np.random.default_rng(3)
    y, x = np.mgrid[:SIDE, :SIDE] + 0.5
    empty = torch.from_numpy(rng.uniform(size=(SIDE, SIDE, 3))).float()

    def disc(left):
        alpha = torch.from_numpy(np.clip(12.5 - np.hypot(x - left, y - 30), 0, 1)).float()
        return alpha, torch.tensor([0.8, 0.3, 0.2]) * alpha[..., None]

    mask, seen = disc(30.0)
    alpha, colours = disc(33.0)
    matte = torch.cat([torch.tensor([0.8, 0.3, 0.2]).expand(SIDE, SIDE, 3), mask[..., None]], dim=-1)
    return {
        "colours": colours,
        "alpha": alpha,
        "matte": matte,
        "picture": composited(seen, mask, empty),
        "empty": empty,
    }


def measured(scene, **changes):
    return captured_metrics(**{**scene, **changes}, networks={}, margin=0.1)


def test_measures_are_those_of_pictures_that_are_put_together_by_hand(scene):
    result = measured(scene)
    alpha, mask = scene["alpha"].numpy()[..., None], scene["matte"].numpy()[..., 3:]
    predicted = scene["colours"].numpy() + 1 - alpha
    filmed = scene["matte"].numpy()[..., :3] * mask + 1 - mask
    window = object_window((alpha[..., 0] > 0.05) | (mask[..., 0] > 0.05), 0.1)
    assert result["psnr"] == pytest.approx(psnr(predicted[window], filmed[window]), abs=1e-4)
    assert result["ssim"] == pytest.approx(ssim(predicted[window], filmed[window]), abs=1e-5)
    whole = scene["colours"].numpy() + (1 - alpha) * scene["empty"].numpy()
    assert result["scene_psnr"] == pytest.approx(psnr(whole, scene["picture"].numpy()), abs=1e-4)
    assert result["scene_ssim"] == pytest.approx(ssim(whole, scene["picture"].numpy()), abs=1e-5)
    # Two discs of radius 12 whose centres are 3 apart.
    part = np.arccos(3 / 24) * 2 * 144 - 1.5 * np.sqrt(4 * 144 - 9)
    assert result["iou"] == pytest.approx(part / (2 * np.pi * 144 - part), abs=0.02)


def test_what_lies_behind_the_object_changes_the_whole_picture_alone(scene):
    other = torch.rand_like(scene["empty"])
    result, changed = measured(scene), measured(scene, picture=other)
    assert (result["psnr"], result["iou"]) == (changed["psnr"], changed["iou"])
    assert changed["scene_psnr"] < 12 < result["scene_psnr"]


def test_a_prediction_that_is_what_was_filmed_is_perfect(scene):
    mask = scene["matte"][..., 3]
    result = measured(scene, colours=scene["matte"][..., :3] * mask[..., None], alpha=mask)
    assert result["psnr"] > 100 and result["scene_psnr"] > 100 and result["iou"] == 1
    assert result["ssim"] == pytest.approx(1) and result["scene_ssim"] == pytest.approx(1)


def test_pictures_of_other_sizes_are_refused(scene):
    with refused("image measures"):
        measured(scene, empty=scene["empty"][:32])
    with refused("image measures"):
        averaged([])


def test_the_empty_scene_gets_the_exposure_of_the_frame():
    background = np.array([[[100, 200, 50]]], np.uint8)
    np.testing.assert_allclose(
        exposed(background, (0.5, 2.0, 1.0), (10, 0, -60)), [[[60 / 255, 1, 0]]], atol=1e-6
    )


def test_differences_are_dark():
    a = np.zeros((2, 3))
    b = a + [[0.1], [0.9]]
    np.testing.assert_allclose(error_picture(a, b), [[0.7] * 3, [0.0] * 3])


def entry(method, take, camera, learned, *values):
    frames = [dict.fromkeys(COLUMNS, value) for value in values]
    return {
        "method": method,
        "title": method,
        "throw": take,
        "camera": camera,
        "learned": learned,
        "frames": frames,
    }


def test_rows_keep_learned_and_held_out_frames_apart():
    rows = image_rows(
        [
            entry("neuma", "one", "left", True, 1.0, 3.0),
            entry("neuma", "one", "right", True, 8.0),
            entry("neuma", "two", "left", False, 5.0),
        ]
    )
    sums = {row["learned"]: row for row in rows if row["throw"] == "all"}
    assert sums[True]["psnr"] == 4 and sums[True]["frames"] == 3  # of frames, not of cameras
    assert sums[False]["psnr"] == 5 and sums[False]["frames"] == 1
    assert [row["psnr"] for row in rows if row["throw"] != "all"] == [2, 8, 5]
    lines = images_csv(rows).splitlines()
    assert lines[0].startswith("method,throw,camera,frames were,frames,psnr,")
    assert lines[1].startswith("neuma,one,left,learned from,2,2.00,") and len(lines) == 6
    assert lines[-1].startswith("neuma,all,all,held out,1,5.00,")
