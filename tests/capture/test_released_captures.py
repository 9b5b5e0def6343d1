"""The real captures of Spring-Gaus and NeuMA's copy of them, in small ones written in both layouts."""

import json

import numpy as np
import pytest
from PIL import Image

from neuma_lib.capture.released import (
    MIDDLE,
    RATE,
    ROOM_FROM_WORLD,
    background_behind,
    photographs_about_to_size,
    read_configured,
    read_released,
    read_shots,
    room_cameras,
    seen_size,
    video_frames,
)
from neuma_lib.config.capture import ReleasedConfig
from neuma_lib.io.images import OPENGL_TO_OPENCV
from neuma_lib.project.released_captures import released_captures
from tests.support import released_layouts as layouts
from tests.support.errors import refused

pytest.importorskip("cv2")
LONGEST = 1000


@pytest.fixture(scope="module")
def folders(tmp_path_factory):
    root = tmp_path_factory.mktemp("released")
    return {
        "spring_gaus": layouts.write_spring_gaus(root / "real_capture"),
        "neuma": layouts.write_neuma(root / "neuma"),
    }


@pytest.fixture(params=["spring_gaus", "neuma"])
def result(request, folders):
    return read_released(folders[request.param], layouts.OBJECT)


def in_room(points):
    """Points (N, 3) of the files' world in the room's metres."""
    origin = np.array([*MIDDLE, layouts.GROUND[layouts.OBJECT]])
    return layouts.UNIT * (np.atleast_2d(points) - origin) @ ROOM_FROM_WORLD.T


def cameras_of(result):
    shots = [frames[0] for frames in result.videos.values()]
    viewmats = room_cameras(np.stack([shot.viewmat for shot in shots]), result.ground, layouts.UNIT)
    return shots, viewmats, np.stack([shot.lens.K for shot in shots])


def test_cameras_see_the_object_where_it_was(result):
    shots, viewmats, Ks = cameras_of(result)
    assert len(shots) == 3 and all(len(frames) == layouts.COUNT for frames in result.videos.values())
    for k in (0, layouts.CONTACT):
        masks = [next(iter(read_shots([frames[k]], LONGEST)))[1] for frames in result.videos.values()]
        middle, radius = seen_size(masks, viewmats, Ks)
        np.testing.assert_allclose(middle, in_room(layouts.motion(k)[0])[0], atol=2e-3)
        assert radius == pytest.approx(layouts.UNIT * np.prod(layouts.RADII) ** (1 / 3), rel=0.1)


def test_the_room_has_its_floor_below_and_metres(result):
    _, viewmats, _ = cameras_of(result)
    eyes = np.linalg.inv(viewmats)[:, :3, 3]
    theirs = np.stack([np.linalg.inv(v)[:3, 3] for v in layouts.poses().values()])
    np.testing.assert_allclose(eyes, in_room(theirs), atol=1e-9)
    assert (eyes[:, 1] > 0).all()
    # proper rotations, which keep y up
    np.testing.assert_allclose(np.linalg.det(viewmats[:, :3, :3]), 1)
    np.testing.assert_allclose(in_room([*MIDDLE, layouts.GROUND[layouts.OBJECT]]), 0, atol=1e-12)


def test_frames_have_the_times_of_the_camera(result):
    shots = next(iter(result.videos.values()))
    frames, world = video_frames(shots, result.ground, layouts.UNIT, 48, 2.0)
    assert [f["step"] for f in frames] == list(range(layouts.COUNT))
    np.testing.assert_allclose([f["time"] for f in frames], np.arange(layouts.COUNT) / RATE)
    assert frames[0]["w"] == 48 and frames[0]["fl_x"] == pytest.approx(shots[0].lens.K[0, 0] / 2)
    pose = np.array(frames[0]["transform_matrix"]) @ OPENGL_TO_OPENCV
    room = np.linalg.inv(room_cameras(shots[0].viewmat[None], result.ground, layouts.UNIT)[0])
    np.testing.assert_allclose(pose[:3, 3] - 2 * room[:3, 3], (0.5, 0, 0.5), atol=1e-12)
    assert world["world"] == {"scale": 2.0, "offset": [0.5, 0.0, 0.5]}


def test_photographs_come_to_the_middle_and_to_size(folders):
    result = read_configured("bun", ReleasedConfig(folder=str(folders["spring_gaus"])))
    assert len(result.photographs) == layouts.PHOTOGRAPHS and result.contact == layouts.CONTACT
    pictures, masks = zip(*read_shots(result.photographs, LONGEST))
    assert pictures[0].shape == (54, 96, 3)  # as large as its mask
    frames, world = photographs_about_to_size(result.photographs, masks, LONGEST, 0.05, 0.2)
    viewmats = np.stack([np.linalg.inv(np.array(f["transform_matrix"]) @ OPENGL_TO_OPENCV) for f in frames])
    Ks = np.stack([[[f["fl_x"], 0, f["cx"]], [0, f["fl_y"], f["cy"]], [0, 0, 1]] for f in frames])
    middle, radius = seen_size(masks, viewmats, Ks)
    np.testing.assert_allclose(middle, (0.5, 0.2, 0.5), atol=1e-6)
    assert radius == pytest.approx(0.05, rel=1e-6)
    assert world["scale_known"] is False
    # One scale for all: distances between cameras keep their ratios.
    eyes = np.linalg.inv(viewmats)[:, :3, 3]
    theirs = np.stack([np.linalg.inv(v)[:3, 3] for v in layouts.static_poses()])
    ratio = np.linalg.norm(eyes[1:] - eyes[0], axis=1) / np.linalg.norm(theirs[1:] - theirs[0], axis=1)
    np.testing.assert_allclose(ratio, world["placed"]["scale"], rtol=1e-9)


def test_the_copy_takes_its_photographs_from_the_original(folders):
    settings = ReleasedConfig(folder=str(folders["neuma"]))
    with refused("captures.released.bun"):
        read_configured("bun", settings)
    settings = settings.model_copy(update={"photographs": str(folders["spring_gaus"])})
    result = read_configured("bun", settings)
    assert len(result.photographs) == layouts.PHOTOGRAPHS and result.contact == 5
    assert list(result.videos) == ["r_0", "r_1", "r_2"]


def test_they_are_captures_like_others(folders):
    result = released_captures({"bun": ReleasedConfig(folder=str(folders["spring_gaus"]), density=300)})
    assert list(result["bun"].takes["first"]) == list(layouts.CAMERAS)
    assert result["bun"].settings.density == 300


def change(path, content):
    """The file with another content until the end of the test."""
    before = path.read_bytes() if path.is_file() else None
    path.unlink() if content is None else path.write_bytes(content)
    return path, before


@pytest.mark.parametrize(
    ("file", "content", "where"),
    [
        ("dynamic/cameras_calib.json", None, ("cameras_calib.json",)),
        ("dynamic/cameras_calib.json", b"{}", ("0.json", "C0733")),
        (
            "dynamic/cameras_calib.json",
            b'{"C0733": {"rvecs": [1], "tvecs": [1, 2, 3]}}',
            ("cameras_calib.json", "C0733"),
        ),
        ("static/colmap/bun/cameras.bin", b"\1", ("cameras.bin",)),
        ("static/colmap/bun/images.bin", b"\1\0\0\0\0\0\0\0\1", ("images.bin",)),
        ("dynamic/videos_masks/C0787/00003.png", None, ("videos_masks/C0787/00003",)),
        (
            "dynamic/sequences/bun/0.json",
            b'{"hit_frame": -1, "C0733": ["00000.jpg"]}',
            ("0.json", "hit_frame"),
        ),
        ("dynamic/sequences/bun/0.json", b'{"C0733": 3}', ("0.json", "C0733")),
        ("dynamic/sequences/bun/0.json", b'{"C0733": []}', ("0.json", "C0733")),
    ],
)
def test_damaged_files_are_named(folders, file, content, where):
    path, before = change(folders["spring_gaus"] / file, content)
    try:
        with refused(*where):
            read_released(folders["spring_gaus"], "bun")
    finally:
        path.write_bytes(before)


def test_what_is_in_no_layout_or_of_no_object_is_named(folders, tmp_path):
    with refused(tmp_path):
        read_released(tmp_path, "bun")
    with refused("dynamic/sequences"):
        read_released(folders["spring_gaus"], "pig")
    with refused("mug"):
        read_released(folders["spring_gaus"], "mug")


def test_an_empty_mask_and_a_picture_of_another_shape_are_named(folders):
    shot = next(iter(read_released(folders["neuma"], "bun").videos.values()))[2]
    path, before = change(shot.mask, None)

    Image.new("L", layouts.SIZE).save(path)
    try:
        with refused("r_0_2.png"):
            list(read_shots([shot], LONGEST))
    finally:
        path.write_bytes(before)
    path, before = change(shot.picture, None)
    Image.new("RGB", (40, 40)).save(path)
    try:
        with refused(shot.picture):
            list(read_shots([shot], LONGEST))
    finally:
        path.write_bytes(before)


def test_times_and_contact_are_plain_json(folders):
    result = read_released(folders["spring_gaus"], "bun")
    frames, _ = video_frames(next(iter(result.videos.values())), result.ground, 0.75, LONGEST)
    assert json.loads(json.dumps(frames)) == frames


def test_the_empty_scene_is_what_masks_do_not_cover():
    """Also where the object lies in most of the frames, of which a plain median would keep it."""
    scene = np.tile(np.arange(40, dtype=np.uint8)[None, :, None], (30, 1, 3))
    pictures, masks = [], []
    for left in (2, 20, 22, 22, 22):
        mask = np.zeros((30, 40), bool)
        mask[10:16, left : left + 6] = True
        pictures.append(np.where(mask[..., None], 200, scene).astype(np.uint8))
        masks.append(mask)
    np.testing.assert_array_equal(background_behind(pictures, masks), scene)
    assert (np.median(pictures, axis=0) == 200).any()
    always = background_behind([pictures[2]] * 3, [masks[2]] * 3)
    np.testing.assert_array_equal(always, pictures[2])
