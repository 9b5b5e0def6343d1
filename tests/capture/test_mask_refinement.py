"""Refined masks of photographs: missing parts, shadows, and masks of other objects."""

import numpy as np
import pytest

from tests.support.ellipsoids import HEIGHT, WIDTH, K, ellipsoid_mask, ring

pytest.importorskip("cv2")

from neuma_lib.capture.masks.agreement import MIN_AGREEMENT, agreement  # noqa: E402
from neuma_lib.capture.masks.mask_refinement import refined_masks  # noqa: E402
from neuma_lib.capture.masks.regions import grown, iou  # noqa: E402

COUNT = 14
VIEWS, KS = ring(COUNT), np.tile(K, (COUNT, 1, 1))


def photographs(rng):
    """Pictures of a red and blue ellipsoid with its shadow on a grey floor of shards, true masks, and shadows."""
    pictures, masks, shadows = [], [], []
    floor = np.kron(rng.uniform(60, 200, (HEIGHT // 8, WIDTH // 8)), np.ones((8, 8)))
    for view in VIEWS:
        mask = ellipsoid_mask(view)
        rows = np.flatnonzero(mask.any(axis=1))
        lower = np.arange(HEIGHT)[:, None] > 0.5 * (rows[0] + rows[-1])
        shadow = np.roll(grown(mask, 7), 5, axis=0) & ~mask & lower
        picture = np.repeat(floor[..., None], 3, axis=2)
        picture[shadow] *= 0.35
        height = (np.arange(HEIGHT)[:, None] - rows[0]) / np.ptp(rows) + np.zeros((1, WIDTH))
        colours = np.where((height < 0.35)[..., None], (70, 60, 200), (190, 40, 50))
        picture[mask] = (colours * (1.2 - 0.7 * height[..., None]))[mask]
        picture = picture * rng.uniform(0.9, 1.1) + rng.normal(0, 2, picture.shape)
        pictures.append(picture.clip(0, 255).round().astype(np.uint8))
        masks.append(mask)
        shadows.append(shadow)
    return pictures, masks, shadows


def test_lost_parts_come_back_shadows_go_and_own_masks_stay():
    pictures, true, shadows = photographs(np.random.default_rng(3))
    first = [mask.copy() for mask in true]
    for i in (2, 7):  # the network dropped the upper third
        rows = np.flatnonzero(true[i].any(axis=1))
        first[i][: rows[0] + len(rows) // 3] = False
    for i in range(0, COUNT, 2):  # and GrabCut took the shadow
        first[i] |= shadows[i]
    first[5] = np.roll(true[5], 60, axis=1)  # something else
    kept = [i == 4 for i in range(COUNT)]
    assert agreement(first, VIEWS, KS)[5] < MIN_AGREEMENT
    before = np.array([iou(a, b) for a, b in zip(first, true)])
    result = refined_masks(pictures, first, VIEWS, KS, kept)
    after = np.array([iou(a, b) for a, b in zip(result, true)])
    assert (result[4] == first[4]).all() and before[4] < 0.93
    assert before[[2, 5, 7]].max() < 0.75 and before[::2].max() < 0.93
    assert np.delete(after, 4).min() > 0.96
    assert agreement(result, VIEWS, KS)[5] > 0.9


def test_what_is_right_stays_right_and_progress_is_reported():
    pictures, true, _ = photographs(np.random.default_rng(4))
    reported = []
    result = refined_masks(pictures, true, VIEWS, KS, progress=lambda *done: reported.append(done))
    assert min(iou(a, b) for a, b in zip(result, true)) > 0.97
    assert reported[-1] == (2 * COUNT, 2 * COUNT) and [done for done, _ in reported] == list(
        range(1, 2 * COUNT + 1)
    )


def test_a_photograph_that_does_not_show_the_body_keeps_its_mask():
    pictures, true, _ = photographs(np.random.default_rng(5))
    views = VIEWS.copy()
    views[3] = np.diag([-1.0, 1.0, -1.0, 1.0]) @ views[3]  # looks the other way
    result = refined_masks(pictures, true, views, KS)
    assert (result[3] == true[3]).all()
    assert min(iou(a, b) for i, (a, b) in enumerate(zip(result, true)) if i != 3) > 0.96
