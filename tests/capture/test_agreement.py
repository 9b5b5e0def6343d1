"""Agreement of masks between views: of a body in all of them, and with one mask that does not belong."""

import numpy as np
import pytest

from neuma_lib.errors import InputError

pytest.importorskip("cv2")

from neuma_lib.capture.masks.agreement import MIN_AGREEMENT, agreement, check_one_object, common_body  # noqa: E402
from tests.support.ellipsoids import HEIGHT, RADII, WIDTH, K, ellipsoid_mask, looking, ring
from tests.support.errors import refused  # noqa: E402


def test_exact_masks_of_one_body_agree():
    views = ring(16)
    result = agreement([ellipsoid_mask(v) for v in views], views, np.tile(K, (16, 1, 1)))
    # The body's outline is drawn in voxels, some 45 of them across: half of one all around is 4 % of the area.
    assert result.min() > 0.93


def test_one_mask_of_something_else_stands_out_and_spares_the_others():
    views = ring(16)
    masks = [ellipsoid_mask(v) for v in views]
    masks[5] = np.roll(masks[5], 60, axis=1)
    y, _ = np.mgrid[:HEIGHT, :WIDTH]
    masks[9] = masks[9] | (y > 180)  # the floor has come along
    result = agreement(masks, views, np.tile(K, (16, 1, 1)))
    assert result[5] < MIN_AGREEMENT and result[9] < MIN_AGREEMENT
    assert np.delete(result, [5, 9]).min() > 0.9


def test_two_fixed_cameras_are_enough():
    views = np.stack([looking((1, 0.5, 0)), looking((0, 0.5, 1))])
    result = agreement([ellipsoid_mask(v) for v in views], views, np.tile(K, (2, 1, 1)))
    assert result.min() > 0.9


def test_masks_of_different_objects_have_no_common_place():
    views = np.stack([looking((1, 0.5, 0)), looking((0, 0.5, 1))])
    masks = [ellipsoid_mask(views[0]), ellipsoid_mask(views[1], centre=(0.1, 0.35, 0))]
    with refused("masks"):
        agreement(masks, views, np.tile(K, (2, 1, 1)))


def test_an_empty_mask_is_named():
    """Failed before: the centre of an empty mask is not a number, and its triangulation raised a LinAlgError."""
    views = ring(4)
    masks = [ellipsoid_mask(v) for v in views]
    masks[2] = np.zeros_like(masks[2])
    with refused("masks", problem="number 2 of 4 is empty"):
        agreement(masks, views, np.tile(K, (4, 1, 1)))


def test_cameras_that_film_different_objects_at_one_place_are_named():
    """The one sees the body, the other a ball of less than half its size where the body would be."""
    views = np.stack([looking((1, 0.5, 0)), looking((0, 0.5, 1))])
    same = agreement([ellipsoid_mask(v) for v in views], views, np.tile(K, (2, 1, 1)))
    check_one_object(same, ["left", "right"], "mug, first")
    masks = [ellipsoid_mask(views[0]), ellipsoid_mask(views[1], radii=np.full(3, 0.03))]
    result = agreement(masks, views, np.tile(K, (2, 1, 1)))
    with pytest.raises(InputError, match="mug, first: .*that of left has an IoU"):
        check_one_object(result, ["left", "right"], "mug, first")


def test_a_part_that_many_pictures_cut_off_is_not_lost_by_one_mask():
    """Twelve of twenty pictures end below the top of the body; one of the other eight has a mask without it."""
    views, cut = ring(20), K.copy()
    cut[1, 2] = 1.0
    Ks = np.stack([K if i % 5 < 2 else cut for i in range(20)])
    masks = [ellipsoid_mask(v) for v in views]
    for i in np.flatnonzero(Ks[:, 1, 2] == 1.0):
        masks[i] = np.roll(masks[i], int(1 - K[1, 2]), axis=0)
        masks[i][int(HEIGHT + 1 - K[1, 2]) :] = False
        assert masks[i][0].any()
    rows = np.flatnonzero(masks[5].any(axis=1))
    masks[5][: rows[len(rows) // 5]] = False
    body = common_body(masks, views, Ks)
    top = body.points[:, 1].max()
    assert abs(top - (0.1 + RADII[1])) < 1.5 * body.voxel
    assert np.delete(body.agreement, 5).min() > 0.9 > body.agreement[5] > MIN_AGREEMENT
