"""Camera poses of a capture: gathered pictures, the board alone, given poses, the room, and COLMAP on photographs."""

import json
import os
from pathlib import Path

import numpy as np
import pytest
from board_pictures import BOARD, LENS, around, picture
from PIL import Image
from test_capture_board import exact, random_similarity

from neuma_lib.capture import board as boards
from neuma_lib.capture import folder as capture_folder
from neuma_lib.capture import placement, poses
from neuma_lib.capture.lens import Lens
from neuma_lib.config.capture import CaptureConfig
from neuma_lib.errors import InputError
from neuma_lib.io.images import OPENGL_TO_OPENCV, read_transforms

pytest.importorskip("cv2")

PLUSH = os.environ.get("NEUMA_PHOTOGRAPHS")
"""Folder with at least ten overlapping photographs of one thing, in the order of their names."""
SETTINGS = CaptureConfig(prior="soft", board=BOARD)


def reconstruction(viewmats, count=None, lens=LENS):
    """Poses as structure from motion gives them, of photographs and a camera `left`, the last."""
    names = [f"photographs/{i}.png" for i in range(len(viewmats) - 1)] + ["left/left.png"]
    points = np.random.default_rng(0).uniform(-0.1, 0.3, (50, 3))
    return poses.Poses(tuple(names), (lens,) * len(names), viewmats, points, np.zeros((50, 3), np.uint8), 0.4)


def save(path, pixels, **options):
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(pixels).save(path, **options)
    return path


def test_notes_to_turn_pictures_are_removed(tmp_path):
    """Pixels stay as the sensor wrote them, to the last bit; other notes stay, the focal length for one."""
    pixels = np.random.default_rng(0).integers(0, 255, (48, 64, 3)).astype(np.uint8)
    exif = Image.Exif()
    exif[poses.ORIENTATION] = 6
    exif[0x010F] = "maker"
    files = [
        save(tmp_path / "a.jpg", pixels, exif=exif, quality=95),
        save(tmp_path / "b.jpg", pixels, quality=95),
        save(tmp_path / "c.png", pixels, exif=exif),
    ]
    found = poses.gather_pictures({"photographs": files}, tmp_path / "work")
    assert list(found) == ["photographs/a.jpg", "photographs/b.jpg", "photographs/c.png"]
    for file, copy in zip(files, found.values()):
        with Image.open(copy) as image, Image.open(file) as original:
            assert image.getexif().get(poses.ORIENTATION, 1) == 1
            np.testing.assert_array_equal(np.asarray(image), np.asarray(original))
    with Image.open(found["photographs/a.jpg"]) as image:
        assert image.getexif()[0x010F] == "maker"
    assert found["photographs/b.jpg"].read_bytes() == files[1].read_bytes()


def test_pictures_of_other_sizes_or_none_are_refused(tmp_path):
    a = save(tmp_path / "a.png", np.zeros((48, 64, 3), np.uint8))
    b = save(tmp_path / "b.png", np.zeros((64, 48, 3), np.uint8))
    with pytest.raises(InputError, match="a.png is 64x48, .*b.png is 48x64"):
        poses.gather_pictures({"photographs": [a, b]}, tmp_path / "work")
    text = tmp_path / "c.png"
    text.write_text("no picture")
    with pytest.raises(InputError, match="c.png cannot be read"):
        poses.gather_pictures({"photographs": [text]}, tmp_path / "work")


def test_too_few_photographs():
    few = {f"photographs/{i}.png": Path(f"{i}.png") for i in range(7)}
    with pytest.raises(InputError, match="7 photographs are too few"):
        poses.structure_from_motion({**few, "left/left.png": Path("left.png")}, "nowhere")


def test_what_found_no_place_is_named():
    whole = reconstruction(around(8))
    poses.check_registered(whole)
    lost = tuple(f"photographs/{i}.png" for i in range(10, 20))
    with pytest.raises(InputError, match=r"only 7 of 17 .* \(not 10.png, .* and 5 more\)"):
        poses.check_registered(poses.replace(whole, lost=lost))
    poses.check_registered(poses.replace(whole, lost=lost[:3]))
    with pytest.raises(InputError, match="fixed camera of left/left.png"):
        poses.check_registered(poses.replace(whole, lost=("left/left.png",)))


def test_room_from_the_board():
    """Whatever the world of the reconstruction, the cameras end where they stood above the floor, y up."""
    rng = np.random.default_rng(5)
    true = around(7)
    world = random_similarity(rng).inverse()
    found = dict(zip(reconstruction(true).names, exact(true)))
    room = poses.room_of(reconstruction(world.move_cameras(true)), found, SETTINGS)
    centres = placement.camera_centres(true)
    wanted = np.stack([centres[:, 0] - 0.09, centres[:, 2], 0.12 - centres[:, 1]], axis=1)
    np.testing.assert_allclose(placement.camera_centres(room.poses.viewmats), wanted, atol=1e-7)
    assert room.board.residual < 1e-8
    down = room.poses.viewmats[:, 1, :3]  # the cameras' y axes point down
    assert (down[:, 1] < 0).all()


def test_room_from_a_stated_length():
    """A rod of 0.15 m on a floor of points; the world is 3 times as large and turned."""
    rng = np.random.default_rng(6)
    true = around(8)
    world = placement.Similarity(3.0, random_similarity(rng).rotation, np.array([1.0, -2, 0.5]))
    floor = np.concatenate([rng.uniform(-0.3, 0.4, (400, 2)), np.zeros((400, 1))], axis=1)
    thing = rng.uniform([0.05, 0.08, 0.02], [0.13, 0.16, 0.1], (200, 3))
    base = reconstruction(world.move_cameras(true))
    base = poses.replace(
        base,
        points=world.apply(np.concatenate([floor, thing])),
        colours=np.zeros((600, 3), np.uint8),
    )
    ends = np.array([[0.02, 0.1, 0.0], [0.02, 0.1, 0.15]])
    marks = {f"{i}.png": LENS.project(ends @ true[i][:3, :3].T + true[i][:3, 3]).tolist() for i in (0, 2, 4)}
    settings = CaptureConfig(prior="soft", length={"metres": 0.15, "ends": marks})
    room = poses.room_of(base, {}, settings)
    assert room.room_from_world.scale * 3 == pytest.approx(1, rel=1e-6)
    heights = placement.camera_centres(room.poses.viewmats)[:, 1]
    np.testing.assert_allclose(heights, 0.4, atol=1e-6)
    np.testing.assert_allclose(room.poses.points[:400, 1], 0, atol=1e-9)
    assert room.floor == pytest.approx(400 / 600)
    unplaced = {"x.png": marks["0.png"], "0.png": marks["0.png"]}
    lost = CaptureConfig(prior="soft", length={"metres": 0.15, "ends": unplaced})
    with pytest.raises(InputError, match="fewer than two of the marked"):
        poses.room_of(base, {}, lost)


def test_given_poses(tmp_path):
    """Pictures are found by group and name or by name; distortion may be given; a missing one is named."""
    true = around(2)
    files = {
        "photographs/0.png": save(tmp_path / "w/photographs/0.png", np.zeros((600, 800, 3), np.uint8)),
        "left/left.png": save(tmp_path / "w/left/left.png", np.zeros((600, 800, 3), np.uint8)),
    }
    frames = [
        {
            "file_path": name,
            "transform_matrix": (np.linalg.inv(v) @ OPENGL_TO_OPENCV).tolist(),
            **LENS.plain(),
        }
        for name, v in zip(("any/photographs/0.png", "left.png"), true)
    ]
    path = tmp_path / "transforms.json"
    path.write_text(json.dumps({"frames": frames}))
    got = poses.given_poses(path, files)
    np.testing.assert_allclose(got.viewmats, true, atol=1e-12)
    np.testing.assert_allclose(got.lenses[0].K, LENS.K)
    np.testing.assert_allclose(got.lenses[1].distortion, LENS.distortion)
    path.write_text(json.dumps({"frames": frames[:1]}))
    with pytest.raises(InputError, match="no frame for left.png"):
        poses.given_poses(path, files)
    path.write_text(json.dumps({"frames": [{**f, "w": 400} for f in frames]}))
    with pytest.raises(InputError, match="w, h of photographs/0.png"):
        poses.given_poses(path, files)


@pytest.fixture(scope="module")
def filmed(tmp_path_factory):
    """A capture of drawn pictures of the board, with lenses, and the true cameras in the board's frame."""
    root = tmp_path_factory.mktemp("captures") / "mug"
    true = around(4)
    small = LENS.resized(720)
    for i, pose in enumerate(true):
        name = f"photos/{i}.png" if i < 3 else "stills/left.png"
        save(root / name, np.repeat(picture(pose, small, samples=2)[..., None], 3, axis=2))
    save(root / "photos/9.png", np.full((small.height, small.width, 3), 90, np.uint8))
    (root / "videos").mkdir()
    (root / "videos/left.mp4").touch()
    lens = small.plain()
    (root / "lenses.json").write_text(json.dumps({"photographs": lens, "left": lens}))
    (root / "capture.yaml").write_text(
        "board: {square: 0.03}\nprior: soft\nposes: board\nlens: lenses.json\nlongest: 600\n"
    )
    return root, true, small


def test_a_capture_by_the_board_alone(filmed, tmp_path):
    """From files to files: cameras within 1.5 mm, one photograph without board left out, and the list of images
    projects the board's corners to where the shrunk pictures show them."""
    root, true, small = filmed
    capture = capture_folder.read_capture(root)
    room, pictures = poses.find_room(capture, tmp_path / "work")
    assert room.poses.lost == ("photographs/9.png",) and len(room.poses.names) == 4
    centres = placement.camera_centres(true)
    wanted = np.stack([centres[:, 0] - 0.09, centres[:, 2], 0.12 - centres[:, 1]], axis=1)
    off = placement.camera_centres(room.poses.viewmats) - wanted
    assert np.linalg.norm(off, axis=1).max() < 1.5e-3
    path = tmp_path / "out/transforms.json"
    told = poses.write_room(path, room, pictures, capture.settings)
    assert told["registered"] == 4 and told["lost"] == ["photographs/9.png"]
    data = read_transforms(path)
    assert data["world"] == {"scale": 1.0, "offset": [0.5, 0.0, 0.5]}
    corners = boards.room_from_board(BOARD, None).apply(boards.corner_positions(BOARD)) + [0.5, 0, 0.5]
    for frame in data["frames"]:
        assert (frame["w"], frame["h"]) == (600, 450)
        view = np.linalg.inv(np.array(frame["transform_matrix"]) @ OPENGL_TO_OPENCV)
        K = np.array([[frame["fl_x"], 0, frame["cx"]], [0, frame["fl_y"], frame["cy"]], [0, 0, 1]])
        pixels = Lens(600, 450, K, np.zeros(5)).project(corners @ view[:3, :3].T + view[:3, 3])
        found = boards.find_board(np.asarray(Image.open(path.parent / frame["file_path"])), BOARD)
        off = found.pixels - pixels[found.ids]
        assert len(found.ids) >= 12 and np.abs(off).mean() < 0.15 and np.abs(off.mean(axis=0)).max() < 0.1
    poses.draw_room(tmp_path / "room.png", room)
    with Image.open(tmp_path / "room.png") as drawn:
        assert drawn.width > 500


def test_scale_places_cameras_in_the_box(filmed, tmp_path):
    root, true, _ = filmed
    capture = capture_folder.read_capture(root)
    room, pictures = poses.find_room(capture, tmp_path / "work")
    half = capture.settings.model_copy(update={"scale": 0.5})
    poses.write_room(tmp_path / "transforms.json", room, pictures, half)
    data = read_transforms(tmp_path / "transforms.json")
    got = np.array([np.array(f["transform_matrix"])[:3, 3] for f in data["frames"]])
    centres = placement.camera_centres(room.poses.viewmats)
    np.testing.assert_allclose(got, 0.5 * centres + [0.5, 0, 0.5], atol=1e-12)
    assert data["world"] == {"scale": 0.5, "offset": [0.5, 0.0, 0.5]}
    assert data["room"]["scale"] == 1.0


def test_a_lens_of_another_size_is_refused(filmed, tmp_path):
    root, _, small = filmed
    lenses = json.loads((root / "lenses.json").read_text())
    (root / "wrong.json").write_text(json.dumps({**lenses, "left": {**lenses["left"], "w": 1280}}))
    capture = capture_folder.read_capture(root)
    wrong = capture_folder.Capture(
        root,
        capture.settings.model_copy(update={"lens": "wrong.json"}),
        capture.photographs,
        capture.stills,
        capture.throws,
    )
    with pytest.raises(InputError, match="lens of 'left' is of 1280x540"):
        poses.find_room(wrong, tmp_path / "work")


@pytest.mark.slow
@pytest.mark.skipif(not PLUSH, reason="NEUMA_PHOTOGRAPHS names no folder")
def test_photographs_find_their_places(tmp_path):
    """Ten photographs, shrunk: all register within a pixel; the last, as a fixed camera, agrees with itself as a
    photograph; the same seed gives the same result."""
    pytest.importorskip("pycolmap")
    files = []
    for file in sorted(Path(PLUSH).glob("*.jpg"))[:10]:
        with Image.open(file) as image:
            image.thumbnail((504, 504), Image.LANCZOS)
            files.append(save(tmp_path / file.name, np.asarray(image), quality=95))
    whole = poses.gather_pictures({"photographs": files}, tmp_path / "whole")
    a = poses.structure_from_motion(whole, tmp_path / "a", seed=3)
    assert len(a.names) == 10 and not a.lost and a.error < 1.0 and len(a.points) > 300
    b = poses.structure_from_motion(whole, tmp_path / "b", seed=3)
    np.testing.assert_array_equal(a.viewmats, b.viewmats)
    split = poses.gather_pictures({"photographs": files[:9], "left": files[9:]}, tmp_path / "split")
    c = poses.structure_from_motion(split, tmp_path / "c", seed=3)
    fit = placement.fit_similarity(
        placement.camera_centres(c.viewmats[:9]), placement.camera_centres(a.viewmats[:9])
    )
    there = placement.camera_centres(fit.move_cameras(c.viewmats))
    spread = np.linalg.norm(there - there.mean(axis=0), axis=1).mean()
    assert np.linalg.norm(there[9] - placement.camera_centres(a.viewmats)[9]) < 0.1 * spread
