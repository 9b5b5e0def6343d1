"""Mattes on disk and back, cameras in metres again, own masks, and the flight's checks."""

from dataclasses import replace

import numpy as np
import pytest
from PIL import Image

pytest.importorskip("cv2")

from neuma_lib.capture.calibration.lens import Lens  # noqa: E402
from neuma_lib.capture.masks import mattes  # noqa: E402
from neuma_lib.capture.masks.regions import read_mask  # noqa: E402
from neuma_lib.capture.masks.video_masks import given_masks  # noqa: E402
from neuma_lib.capture.motion import flight
from neuma_lib.io.images import (  # noqa: E402
    OPENGL_TO_OPENCV,
    read_image_set,
    read_labels,
    transform_world,
    write_transforms,
)
from neuma_lib.project.capture_folder import read_capture  # noqa: E402
from tests.support.errors import refused  # noqa: E402

WIDTH, HEIGHT = 80, 60
K = np.array([[70.0, 0, 41.0], [0, 71.0, 29.0], [0, 0, 1]])


def disc(x, y=30.0, radius=9.0):
    rows, columns = np.mgrid[:HEIGHT, :WIDTH] + 0.5
    return (columns - x) ** 2 + (rows - y) ** 2 <= radius**2


@pytest.fixture
def room(tmp_path):
    """A room's transforms.json with one still, twice as large in the simulator as in metres; its camera in metres."""
    view = np.eye(4)
    view[:3, :3] = [[0, 0, -1], [0, -1, 0], [-1, 0, 0]]
    view[:3, 3] = (0.1, 0.4, 1.5)
    (tmp_path / "left").mkdir()
    Image.new("RGB", (WIDTH, HEIGHT), (90, 80, 70)).save(tmp_path / "left/left.png")
    lens = Lens(WIDTH, HEIGHT, K, np.zeros(5))
    frame = {"file_path": "left/left.png", "group": "left", "view": 0, "step": 0, **lens.intrinsics()}
    frame["transform_matrix"] = (np.linalg.inv(view) @ OPENGL_TO_OPENCV).tolist()
    path = tmp_path / "transforms.json"
    world = transform_world([frame], 2.0, (0.5, 0.0, 0.5))
    write_transforms(path, {}, [frame], **world)
    return path, view, world["world"]


def test_cameras_are_those_of_the_room_again(room):
    path, view, world = room
    (frame,) = mattes.room_frames(path, "left")
    result, intrinsics = mattes.metric_camera(frame, world)
    np.testing.assert_allclose(result, view, atol=1e-12)
    np.testing.assert_array_equal(intrinsics, K)
    with refused(path):
        mattes.room_frames(path, "right")


def test_mattes_are_read_as_they_were_written(room, tmp_path):
    path, _, world = room
    (still,) = mattes.room_frames(path, "left")
    pixels = np.full((HEIGHT, WIDTH, 3), (200, 60, 50), np.uint8)
    masks = [disc(30 + 5 * i) for i in range(3)]
    entries = [({**still, "file_path": f"{i}.png", "step": i}, pixels, mask) for i, mask in enumerate(masks)]
    mattes.write_mattes(tmp_path / "out/transforms.json", entries, mattes.world_of(path))
    result = read_image_set(tmp_path / "out/transforms.json")
    # A straight edge blurred has its half at the same place; on a disc of 9 px a few pixels of 254 differ.
    for image, mask in zip(result.images, masks):
        assert ((image[..., 3] > 127) ^ mask).sum() <= 8
        assert (image[image[..., 3] > 0, :3] == (200, 60, 50)).all() and (
            image[image[..., 3] == 0] == 0
        ).all()
    assert result.steps.tolist() == [0, 1, 2]


def test_own_masks_are_undistorted_as_their_pictures_are(tmp_path):
    lens = Lens(WIDTH, HEIGHT, K, np.array([-0.4, 0, 0, 0, 0.0]))
    mask = disc(60, 20)
    Image.fromarray(255 * mask.astype(np.uint8)).save(tmp_path / "a.png")
    result = mattes.own_mask(tmp_path / "a.png", lens, 1000)
    middle = np.argwhere(result).mean(axis=0)[::-1] + 0.5
    # where the undistorting pinhole sees the disc's middle
    direction = lens.directions(np.array([[60.0, 20.0]]))[0]
    expected = direction * lens.pinhole().K[[0, 1], [0, 1]] + lens.pinhole().K[:2, 2]
    assert np.linalg.norm(expected - (60, 20)) > 1
    np.testing.assert_allclose(middle, expected, atol=0.5)


@pytest.mark.parametrize(
    ("labels", "colours"),
    [
        ({"ball": 1, "block": 200}, [0, 1, 200]),
        ({"ball": "#ff0000", "block": "#0040C0"}, [(0, 0, 0), (255, 0, 0), (0, 64, 192)]),
    ],
)
def test_label_images_number_the_bodies(tmp_path, labels, colours):
    """In the order of the settings, each undistorted as a mask; black is none of them. Written numbers are read."""
    lens = Lens(WIDTH, HEIGHT, K, np.array([-0.4, 0, 0, 0, 0.0]))
    numbers = disc(60, 20) + 2 * disc(25, 40).astype(np.uint8)
    Image.fromarray(np.array(colours, np.uint8)[numbers]).save(tmp_path / "a.png")
    result = mattes.own_mask(tmp_path / "a.png", lens, 1000, labels)
    for k in (1, 2):
        Image.fromarray(255 * (numbers == k).astype(np.uint8)).save(tmp_path / "b.png")
        np.testing.assert_array_equal(result == k, mattes.own_mask(tmp_path / "b.png", lens, 1000))
    frame = {"file_path": "0.png", **lens.pinhole().intrinsics(), "transform_matrix": np.eye(4).tolist()}
    pixels = np.full((HEIGHT, WIDTH, 3), 90, np.uint8)
    mattes.write_mattes(tmp_path / "out/transforms.json", [(frame, pixels, result)], {})
    np.testing.assert_array_equal(read_labels(tmp_path / "out/transforms.json")[0], result)


def test_label_images_of_a_palette_have_its_indices(tmp_path):
    numbers = disc(60, 20) + 2 * disc(25, 40).astype(np.uint8)
    image = Image.fromarray(numbers)
    image.putpalette([0, 0, 0, 128, 0, 0, 0, 128, 0])
    image.save(tmp_path / "a.png")
    result = read_mask(tmp_path / "a.png", (WIDTH, HEIGHT), {"block": 2, "ball": 1})
    np.testing.assert_array_equal(result, np.array([0, 2, 1])[numbers])


def test_labels_of_no_body_are_refused(tmp_path):
    """A forgotten body, and smoothed edges, are named with the most frequent label."""
    Image.fromarray(np.array([0, 40, 90], np.uint8)[disc(60, 20) + 2 * disc(25, 40)]).save(tmp_path / "a.png")
    with refused("a.png", problem="256 pixels have labels of no body, most of them 90; the bodies have 40"):
        read_mask(tmp_path / "a.png", (WIDTH, HEIGHT), {"ball": 40, "block": 200})
    with refused("a.png", problem="#5a5a5a"):
        read_mask(tmp_path / "a.png", (WIDTH, HEIGHT), {"ball": "#282828", "block": "#ff0000"})
    Image.new("L", (WIDTH, HEIGHT)).save(tmp_path / "b.png")
    with refused("b.png", problem="empty"):
        read_mask(tmp_path / "b.png", (WIDTH, HEIGHT), {"ball": 40, "block": 200})


def test_several_bodies_need_masks(tmp_path):
    (tmp_path / "capture.yaml").write_text("bodies: {ball: {label: 1}, block: {label: 2}}\n")
    with refused("photographs", problem="no masks, which several bodies need"):
        read_capture(tmp_path).own_masks("photographs")


def test_own_masks_of_a_video_show_its_flight():
    times = np.arange(12) / 60
    masks = np.stack([disc(15 + 200 * t, 12 + 0.5 * 1500 * t * t) for t in times])
    masks[5] = False
    result = given_masks(masks, times)
    assert result.masks is masks and [track.frames for track in result.tracks] == [(0, 11)]
    assert given_masks(masks[:3], times[:3]).tracks == ()


def test_own_masks_lie_in_the_captures_folder(tmp_path):
    capture = tmp_path / "mug"
    (capture / "masks/photographs").mkdir(parents=True)
    (capture / "capture.yaml").write_text("board: {square: 0.03}\n")
    Image.new("L", (4, 4), 255).save(capture / "masks/photographs/a.png")
    result = read_capture(capture)
    assert list(result.own_masks("photographs")) == ["a"] and result.own_masks("first/left") == {}
    Image.new("L", (4, 4), 255).save(tmp_path / "other.png")
    (capture / "masks/photographs/b.png").symlink_to(tmp_path / "other.png")
    with refused("b.png"):
        result.own_masks("photographs")


def test_a_camera_that_saw_no_flight_is_named():
    seen = flight.Filmed(
        "left",
        np.arange(3),
        np.arange(3) / 60,
        np.zeros((3, HEIGHT, WIDTH, 3), np.uint8),
        np.stack([disc(30)] * 3),
        None,
        np.eye(4),
        K,
        HEIGHT,
    )
    with refused("mug, first, left"):
        flight.find_flight([seen], "mug, first")
    wide = disc(30).any(axis=0).sum() / WIDTH, disc(30).any(axis=1).sum() / HEIGHT
    assert seen.row_delay == pytest.approx(max(wide) / 60)  # a frame takes at most 1/60 s
    assert replace(seen, row_time=1e-5).row_delay == 0
