"""Masks of an object that is selected by a box among other objects, and boxes that select nothing."""

import numpy as np
import pytest
from scipy import ndimage

from tests.support.cluttered_rooms import cluttered_room
from tests.support.errors import refused

pytest.importorskip("cv2")

from neuma_lib.capture.calibration.lens import Lens  # noqa: E402
from neuma_lib.capture.masks import selection as module  # noqa: E402
from neuma_lib.capture.masks.regions import box_of, iou  # noqa: E402
from neuma_lib.capture.masks.saliency import Saliency, fetch_network  # noqa: E402
from neuma_lib.capture.masks.selection import Box, box_in, selected_masks  # noqa: E402

SEEDS = range(21, 27)
"""Rooms of the reported numbers. Parameters were chosen with seeds 1 to 4."""
GOAL = 0.95


def box_around(mask, margin=2):
    rows, columns = box_of(mask, margin)
    return Box(np.array([columns.start, rows.start], float), np.array([columns.stop, rows.stop], float))


def nothing(pixels):
    """A network that has no opinion."""
    return np.full(pixels.shape[:2], 0.5)


@pytest.fixture(scope="module")
def room():
    return cluttered_room(1, 12)


def select(room, boxes, saliency=nothing, floor=0.0, **changed):
    given = {"points": room.points, "seen": room.seen} | changed
    arguments = room.pictures, room.viewmats, room.Ks, boxes, given["points"], given["seen"]
    return selected_masks(*arguments, saliency, "capture", floor)


def largest(room):
    return int(np.argmax([mask.sum() for mask in room.masks]))


def test_one_box_selects_the_object_in_all_photographs(room):
    first = largest(room)
    masks = select(room, {first: box_around(room.masks[first])})
    ious = [iou(a, b) for a, b in zip(masks, room.masks)]
    assert np.mean(ious) > GOAL and min(ious) > 0.85


def test_a_point_selects_the_object(room):
    """The point farthest from the border of the object, as a person would click."""
    first = largest(room)
    inside = ndimage.distance_transform_edt(room.masks[first])
    row, column = np.unravel_index(inside.argmax(), inside.shape)
    lens = Lens(room.masks[first].shape[1], room.masks[first].shape[0], room.Ks[first], np.zeros(5))
    box = box_in((column + 0.5, row + 0.5), None, lens, room.Ks[first])
    assert box.guessed
    np.testing.assert_allclose(box.middle, (column + 0.5, row + 0.5))
    ious = [iou(a, b) for a, b in zip(select(room, {first: box}), room.masks)]
    assert np.mean(ious) > GOAL - 0.01 and min(ious) > 0.85


def test_without_points_on_the_object_the_floor_locates_it(room):
    """Points of the floor behind an object without texture are not its own."""
    first = largest(room)
    none = {"points": np.zeros((0, 3)), "seen": np.zeros((len(room.masks), 0), bool)}
    low = room.points[:, 1] < 0.01
    below = {"points": room.points[low], "seen": room.seen[:, low]}
    for points in (none, below):
        masks = select(room, {first: box_around(room.masks[first])}, **points)
        assert np.mean([iou(a, b) for a, b in zip(masks, room.masks)]) > 0.9


def test_a_fitted_floor_does_not_cut_what_sank_into_a_bed(room):
    """Points near the object that are below the floor show that it is a bed. Without them its part there is cut off."""
    first = largest(room)
    high, box = 0.1, {first: box_around(room.masks[first])}
    assert np.mean([iou(a, b) for a, b in zip(select(room, box, floor=high), room.masks)]) > GOAL
    above = room.points[:, 1] > high
    with refused("capture"):
        select(room, box, floor=high, points=room.points[above], seen=room.seen[:, above])


def test_the_shadow_of_the_object_is_one_of_its_surroundings():
    """A floor at 0.3 of its brightness is no object, although no photograph shows a floor of this colour elsewhere."""
    rng = np.random.default_rng(0)
    floor, body = rng.normal((180, 150, 110), 12, (5000, 3)), rng.normal((60, 140, 70), 12, (2000, 3))
    shadow = 0.3 * floor[:500]
    object_ = module.colour_shares(
        np.concatenate([body, shadow[:200]])
    )  # of a silhouette with some shadow in it
    ratios = [
        module.log_ratio(object_, around)[module.colour_bins(shadow)].mean()
        for around in (module.colour_shares(floor), module._shaded_shares(floor))
    ]
    assert ratios[0] > 2 and ratios[1] < 0.5 * ratios[0]
    kept = module.log_ratio(object_, module._shaded_shares(floor))[module.colour_bins(body)]
    assert np.median(kept) > 2


def test_a_ball_on_the_floor_is_located_by_its_box():
    """Exact up to the perspective of a ball, (radius / distance)^2 = 0.6 %, in a camera that is turned at random."""
    rng = np.random.default_rng(0)
    eye, centre, radius = np.array([0.3, 0.9, -0.8]), np.array([0.1, 0.1, 0.2]), 0.1
    ray = (centre - eye) / np.linalg.norm(centre - eye)
    across = np.cross(ray, rng.normal(size=3))
    across /= np.linalg.norm(across)
    rotation = np.stack([across, np.cross(ray, across), ray])
    viewmat = np.eye(4)
    viewmat[:3, :3], viewmat[:3, 3] = rotation, -rotation @ eye
    K = np.array([[500.0, 0, 320], [0, 500.0, 240], [0, 0, 1]])
    half = 500 * radius / np.linalg.norm(centre - eye)
    box = Box(np.array([320 - half, 240 - half]), np.array([320 + half, 240 + half]))
    arguments = viewmat[None], K[None], {0: box}, np.zeros((0, 3)), np.zeros((1, 0), bool)
    place, size = module.locate(*arguments, (np.zeros(3), np.array([0, 1.0, 0])))
    np.testing.assert_allclose(place, centre, atol=0.006 * np.linalg.norm(centre - eye))
    np.testing.assert_allclose(size, radius, rtol=0.006)
    assert module.locate(*arguments) is None


def test_a_box_that_is_much_larger_than_the_object_is_refused(room):
    first = largest(room)
    box = box_around(room.masks[first])
    with refused("capture"):
        select(room, {first: Box(box.lower - 0.8 * box.half, box.upper + 0.8 * box.half)})


def test_space_between_a_camera_and_a_point_that_it_sees_is_empty():
    ticks = (np.arange(module._VOXELS) + 0.5) / module._VOXELS * 2 - 1
    voxels = np.stack(np.meshgrid(ticks, ticks, ticks, indexing="ij"), axis=-1).reshape(-1, 3)
    viewmats = np.stack([np.eye(4), np.eye(4)])
    viewmats[0, 2, 3] = viewmats[1, 2, 3] = 3.0  # at z = -3
    points = np.array([[0.0, 0.0, 0.2], [0.5, 0.5, 0.2]])
    counts = module._sight_rays(
        voxels, 2 / module._VOXELS, viewmats, points, np.array([[1, 0], [1, 0]], bool)
    )
    on_ray = np.hypot(voxels[:, 0], voxels[:, 1]) < 2 / module._VOXELS
    before, behind = voxels[:, 2] < 0.05, voxels[:, 2] > 0.25
    assert counts[on_ray & before].min() > 0.1
    assert counts[on_ray & behind].max() < 1e-3
    assert counts[np.hypot(voxels[:, 0], voxels[:, 1]) > 0.3].max() == 0


@pytest.mark.parametrize(
    ("orientation", "rectangle"),
    [(None, (10, 20, 50, 90)), (6, (210, 10, 280, 50)), (3, (350, 210, 390, 280)), (8, (20, 350, 90, 390))],
)
def test_a_box_of_a_displayed_photograph_is_that_of_the_sensor(orientation, rectangle):
    """The same rectangle of a sensor of 400 x 300 pixels, as viewers show it for each EXIF orientation."""
    K = np.array([[380.0, 0, 200], [0, 380.0, 150], [0, 0, 1]])
    box = box_in(rectangle, orientation, Lens(400, 300, K, np.zeros(5)), K)
    np.testing.assert_allclose([*box.lower, *box.upper], (10, 20, 50, 90), atol=1e-6)


@pytest.mark.slow
def test_cluttered_rooms(tmp_path_factory):
    """IoU in six rooms with 12 other objects each, of which some hide the selected one, and one has its colour."""
    network = Saliency(fetch_network(tmp_path_factory.getbasetemp()))
    means = []
    for seed in SEEDS:
        room = cluttered_room(seed)
        first = largest(room)
        masks = select(room, {first: box_around(room.masks[first])}, network)
        areas = np.array([mask.sum() for mask in room.masks])
        visible = areas > 0.1 * np.median(areas)  # one is behind a cupboard
        ious = np.array([iou(a, b) for a, b in zip(masks, room.masks)])[visible]
        means.append(ious.mean())
        scores = (
            f"{ious.mean():.3f} in the mean, {np.median(ious):.3f} in the median, {ious.min():.3f} at least"
        )
        print(f"room {seed}: {len(ious)} photographs, IoU {scores}")
    assert np.mean(means) > GOAL
