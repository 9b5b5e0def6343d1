"""The upward direction from several cues: how photographs are held, their EXIF orientation, and the floor."""

import numpy as np
import pytest
from PIL import Image, ImageOps

from neuma_lib.capture.calibration.placement import Similarity, camera_centres, fit_floor
from neuma_lib.capture.calibration.vertical import QUARTER_TURNS, Cue, camera_cues, check_vertical, read_cues
from neuma_lib.capture.pictures import ORIENTATION
from tests.support.errors import refused
from tests.support.similarities import random_similarity


def test_quarter_turns_are_those_of_pillow():
    stored = np.arange(24, dtype=np.uint8).reshape(4, 6)
    for orientation, quarters in QUARTER_TURNS.items():
        image = Image.fromarray(stored)
        image.getexif()[ORIENTATION] = orientation
        np.testing.assert_array_equal(np.rot90(stored, -quarters), np.asarray(ImageOps.exif_transpose(image)))


def held(count, orientations, roll=4.0, seed=0, sector=2 * np.pi):
    """Cameras around the origin of a world with z up, in sensor orientation, rolled by some degrees."""
    rng = np.random.default_rng(seed)
    views = []
    for k, orientation in enumerate(orientations):
        angle, height = sector * k / count, rng.uniform(0.3, 0.8)
        centre = np.array([np.cos(angle), np.sin(angle), height])
        forward = -centre / np.linalg.norm(centre)
        right = np.cross(forward, (0, 0, 1.0))
        right /= np.linalg.norm(right)
        down = np.cross(forward, right)
        # A stored picture that needs clockwise turns was taken with its left side up.
        a = np.radians(rng.normal(0, roll) + 90 * QUARTER_TURNS[orientation])
        pose = np.eye(4)
        pose[:3, :3] = np.stack(
            [np.cos(a) * right + np.sin(a) * down, np.cos(a) * down - np.sin(a) * right, forward]
        )
        pose[:3, 3] = -pose[:3, :3] @ centre
        views.append(pose)
    return np.stack(views)


def up_cue(name="floor", tilt=0.0):
    return Cue(name, np.array([np.sin(np.radians(tilt)), 0.0, np.cos(np.radians(tilt))]))


@pytest.mark.parametrize("orientation", [1, 3, 6, 8])
def test_up_follows_from_cameras_held_by_hand_whichever_way_the_sensor_is_turned(orientation):
    """Four degrees of roll in 24 photographs leave about one degree."""
    tags = [orientation] * 24
    cameras, exif = camera_cues(held(24, tags), tags)
    assert cameras.name == "cameras" and exif.name == "EXIF orientation"
    assert max(cameras.angle(up_cue()), exif.angle(up_cue())) < 3 and 0.5 < cameras.deviation < 3


def test_some_turned_photographs_without_a_tag_do_not_matter():
    turned = [6 if k % 3 == 0 else 1 for k in range(24)]
    (cameras,) = camera_cues(held(24, turned), [None] * 24)
    assert cameras.angle(up_cue()) < 3
    # A phone that was held flat wrote a wrong orientation into all of its photographs.
    cameras, exif = camera_cues(held(24, [1] * 24), [1 if k % 3 else 8 for k in range(24)])
    assert cameras.angle(up_cue()) < 3 < exif.deviation


def test_photographs_from_one_side_leave_the_direction_uncertain():
    full = camera_cues(held(24, [1] * 24), [None] * 24)[0]
    side = camera_cues(held(24, [1] * 24, sector=np.radians(25)), [None] * 24)[0]
    assert side.deviation > 3 * full.deviation
    assert side.angle(up_cue()) < 3 * side.deviation


def test_cues_that_disagree_are_named_with_their_angles():
    cameras = Cue("cameras", up_cue(tilt=3).up, 1.0)
    assert "cameras 3.0 +- 1.0 degrees" in check_vertical([up_cue(), cameras], "mug")
    check_vertical([up_cue(), Cue("cameras", up_cue(tilt=40).up, 14.0)], "mug")  # uncertain
    with refused("mug", problem="floor and cameras 17 degrees"):
        check_vertical([up_cue(), Cue("cameras", up_cue(tilt=17).up, 0.5)], "mug")
    wall = [
        up_cue("floor", 89.0),
        Cue("cameras", up_cue().up, 1.0),
        Cue("EXIF orientation", up_cue().up, 1.0),
    ]
    with refused("mug", problem="floor differs from most others") as caught:
        check_vertical(wall, "mug")
    assert "floor and cameras 89 degrees" in caught.value.problem
    assert read_cues([cue.plain() for cue in wall])[1].angle(wall[1]) == 0


def test_a_wall_with_more_points_than_the_floor_is_not_the_floor():
    """Failed before: the plane with most points was the wall, 90 degrees off, and no check noticed."""
    rng = np.random.default_rng(4)
    true = random_similarity(rng)
    floor = np.stack([*rng.uniform(-1, 1, (2, 200)), rng.normal(0, 1e-3, 200)], axis=1)
    wall = np.stack([np.full(600, -2.0), *rng.uniform(-1, 1, (2, 600))], axis=1)
    views = held(12, [1] * 12)
    points, cameras = true.apply(np.concatenate([floor, wall])), true.apply(camera_centres(views))
    cue = camera_cues(true.move_cameras(views), [None] * 12)[0]
    up = true.rotation[:, 2]
    plane = fit_floor(points, cameras, 4e-3 * true.scale, 0)[1]
    assert plane @ up < 0.1
    plane = fit_floor(points, cameras, 4e-3 * true.scale, 0, cue.up, 15.0)[1]
    assert np.degrees(np.arccos(plane @ up)) < 0.2
    with refused("photographs", problem="within 15 degrees of the level of the cameras"):
        fit_floor(points[200:], cameras, 4e-3 * true.scale, 0, cue.up, 15.0)


def test_cues_turn_with_the_world():
    turn = Similarity(1.0, random_similarity(np.random.default_rng(1)).rotation, np.zeros(3))
    views = held(9, [1] * 9)
    before, after = (camera_cues(v, [1] * 9)[0] for v in (views, turn.move_cameras(views)))
    np.testing.assert_allclose(after.up, turn.rotation @ before.up, atol=1e-9)
