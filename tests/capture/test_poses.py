"""Camera poses of a capture: gathered pictures, the board alone, given poses, the room, and COLMAP on photographs."""

import json
from pathlib import Path

import numpy as np
import pytest
import yaml
from PIL import Image

from neuma_lib.capture import pictures as pics
from neuma_lib.capture.calibration import board as boards
from neuma_lib.capture.calibration import drawing, placement, poses
from neuma_lib.capture.calibration import room as rooms
from neuma_lib.capture.calibration.lens import Lens, read_lens
from neuma_lib.capture.masks.regions import read_mask
from neuma_lib.capture.motion.gravity import Gravity
from neuma_lib.config.capture import CaptureConfig
from neuma_lib.errors import InputError
from neuma_lib.io.images import OPENGL_TO_OPENCV, read_transforms
from neuma_lib.project import capture_folder
from tests.support.board_pictures import BOARD, LENS, ROOM_LENSES, around, picture, room_cameras, room_picture
from tests.support.errors import refused
from tests.support.similarities import exact, random_similarity

pytest.importorskip("cv2")

SETTINGS = CaptureConfig(board=BOARD)


def reconstruction(viewmats):
    """Poses as structure from motion gives them, of photographs and a camera `left`, the last."""
    names = [f"photographs/{i}.png" for i in range(len(viewmats) - 1)] + ["left/left.png"]
    points = np.random.default_rng(0).uniform(-0.1, 0.3, (50, 3))
    return poses.Poses(tuple(names), (LENS,) * len(names), viewmats, points, np.zeros((50, 3), np.uint8), 0.4)


def save(path, pixels, **options):
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(pixels).save(path, **options)
    return path


def test_notes_to_turn_pictures_are_removed(tmp_path):
    """Pixels stay as the sensor wrote them, to the last bit; other notes stay, the focal length for one."""
    pixels = np.random.default_rng(0).integers(0, 255, (48, 64, 3)).astype(np.uint8)
    exif = Image.Exif()
    exif[pics.ORIENTATION] = 6
    exif[0x010F] = "maker"
    files = [
        save(tmp_path / "a.jpg", pixels, exif=exif, quality=95),
        save(tmp_path / "b.jpg", pixels, quality=95),
        save(tmp_path / "c.png", pixels, exif=exif),
    ]
    result = pics.copy_pictures(pics.name_pictures({"photographs": files}), tmp_path / "work")
    assert list(result) == ["photographs/a.jpg", "photographs/b.jpg", "photographs/c.png"]
    for file, copy in zip(files, result.values()):
        with Image.open(copy) as image, Image.open(file) as original:
            assert image.getexif().get(pics.ORIENTATION, 1) == 1
            np.testing.assert_array_equal(np.asarray(image), np.asarray(original))
    with Image.open(result["photographs/a.jpg"]) as image:
        assert image.getexif()[0x010F] == "maker"
    assert result["photographs/b.jpg"].read_bytes() == files[1].read_bytes()


def test_photographs_that_are_stored_turned_are_turned_back(tmp_path):
    """Two in the sensor's orientation, one stored upright without a note: its lens is that of the others."""
    pixels = np.random.default_rng(0).integers(0, 255, (48, 64, 3)).astype(np.uint8)
    upright = np.rot90(pixels, -1)  # the phone was held upright and turned the picture
    files = [save(tmp_path / f"{k}.png", p) for k, p in enumerate((pixels, pixels, upright))]
    named = pics.name_pictures({"photographs": files})
    assert set(pics.sensor_sizes(named).values()) == {(64, 48)}
    np.testing.assert_array_equal(pics.read_picture(files[2], (64, 48)), pixels)
    for copy in pics.copy_pictures(named, tmp_path / "work").values():
        np.testing.assert_array_equal(pics.read_picture(copy), pixels)
    assert [pics.orientation_of(file, (64, 48)) for file in files] == [None, None, 6]
    save(tmp_path / "mask.png", np.where(upright > 127, 255, 0).astype(np.uint8)[..., 0])
    mask = read_mask(tmp_path / "mask.png", (64, 48))
    np.testing.assert_array_equal(mask, pixels[..., 0] > 127)


def test_heic_photographs_are_converted(tmp_path):
    heif = pytest.importorskip("pillow_heif")
    heif.register_heif_opener()
    pixels = np.full((48, 64, 3), (200, 60, 50), np.uint8)
    file = save(tmp_path / "a.heic", pixels, quality=95)
    named = pics.name_pictures({"photographs": [file]})
    assert list(named) == ["photographs/a.png"] and pics.picture_size(file) == (64, 48)
    (copy,) = pics.copy_pictures(named, tmp_path / "work").values()
    with Image.open(copy) as image:
        assert image.format == "PNG"
        np.testing.assert_allclose(np.asarray(image.convert("RGB")).astype(int), pixels, atol=6)


def test_pictures_of_other_sizes_or_none_are_refused(tmp_path):
    a = save(tmp_path / "a.png", np.zeros((48, 64, 3), np.uint8))
    b = save(tmp_path / "b.png", np.zeros((64, 40, 3), np.uint8))
    with pytest.raises(InputError, match="b.png: 40x64 .*a.png has 64x48"):
        pics.name_pictures({"photographs": [a, b]})
    text = tmp_path / "c.png"
    text.write_text("no picture")
    with refused("c.png"):
        pics.name_pictures({"photographs": [text]})


def test_too_few_photographs():
    few = {f"photographs/{i}.png": Path(f"{i}.png") for i in range(7)}
    with refused("photographs"):
        poses.structure_from_motion({**few, "left/left.png": Path("left.png")}, "nowhere")


def test_what_found_no_place_is_named():
    whole = reconstruction(around(8))
    poses.check_registered(whole)
    lost = tuple(f"photographs/{i}.png" for i in range(10, 20))
    with pytest.raises(InputError, match=r"7 of 17 .* \(not 10.png, .* and 5 more\)"):
        poses.check_registered(poses.replace(whole, lost=lost))
    poses.check_registered(poses.replace(whole, lost=lost[:3]))
    with refused("photographs", problem="they show two scenes without common points"):
        poses.check_registered(poses.replace(whole, lost=lost), [set(whole.names), set(lost)])
    with refused("left/left.png"):
        poses.check_registered(poses.replace(whole, lost=("left/left.png",)))


@pytest.mark.parametrize(
    ("change", "believed"),
    [
        ({}, True),
        ({"cx": 411.3}, True),
        ({"cx": 420.0}, False),
        ({"cy": 260.0}, False),
        ({"fl_y": 715.0}, False),
    ],
)
def test_lenses_that_no_phone_has_are_not_believed(change, believed):
    """At most 16 of 800 pixels off the centre, and 1 % stretched."""
    centred = {"fl_x": 700.0, "fl_y": 700.0, "cx": 400.0, "cy": 300.0, "w": 800, "h": 600}
    assert poses.plausible(read_lens({**centred, **change}, "here")) is believed


def test_room_from_the_board():
    """Whatever the world of the reconstruction, the cameras end where they stood above the floor, y up."""
    rng = np.random.default_rng(5)
    true = around(7)
    world = random_similarity(rng).inverse()
    result = dict(zip(reconstruction(true).names, exact(true)))
    room = rooms.room_of(reconstruction(world.move_cameras(true)), result, SETTINGS)
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
    object_points = rng.uniform([0.05, 0.08, 0.02], [0.13, 0.16, 0.1], (200, 3))
    base = reconstruction(world.move_cameras(true))
    base = poses.replace(
        base, points=world.apply(np.concatenate([floor, object_points])), colours=np.zeros((600, 3), np.uint8)
    )
    ends = np.array([[0.02, 0.1, 0.0], [0.02, 0.1, 0.15]])
    marks = {f"{i}.png": LENS.project(ends @ true[i][:3, :3].T + true[i][:3, 3]).tolist() for i in (0, 2, 4)}
    settings = CaptureConfig(length={"metres": 0.15, "ends": marks})
    room = rooms.room_of(base, {}, settings)
    assert room.room_from_world.scale * 3 == pytest.approx(1, rel=1e-6)
    heights = placement.camera_centres(room.poses.viewmats)[:, 1]
    np.testing.assert_allclose(heights, 0.4, atol=1e-6)
    np.testing.assert_allclose(room.poses.points[:400, 1], 0, atol=1e-9)
    assert room.floor == pytest.approx(400 / 600)
    unplaced = {"x.png": marks["0.png"], "0.png": marks["0.png"]}
    lost = CaptureConfig(length={"metres": 0.15, "ends": unplaced})
    with refused("length.ends"):
        rooms.room_of(base, {}, lost)


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
    with refused(path):
        poses.given_poses(path, files)
    path.write_text(json.dumps({"frames": [{**f, "w": 400} for f in frames]}))
    with refused(path, "photographs/0.png"):
        poses.given_poses(path, files)


def test_poses_are_written_and_read(tmp_path):
    """To the last bit, but for points, which a viewer wants in single precision."""
    poses_of_all = reconstruction(around(4))
    poses_of_all = poses.replace(poses_of_all, lost=("photographs/9.png",))
    poses_of_all = poses.replace(poses_of_all, unsure={"left/left.png": (0.1, 0.9, 0.05)})
    poses.save_poses(tmp_path / "poses.json", tmp_path / "points.ply", poses_of_all)
    again = poses.load_poses(tmp_path / "poses.json", tmp_path / "points.ply")
    assert (again.names, again.lost, again.error) == (poses_of_all.names, poses_of_all.lost, 0.4)
    assert again.unsure == poses_of_all.unsure
    np.testing.assert_array_equal(again.viewmats, poses_of_all.viewmats)
    np.testing.assert_array_equal([lens.K for lens in again.lenses], [LENS.K] * 4)
    np.testing.assert_allclose(again.points, poses_of_all.points, rtol=1e-6)
    nothing = np.empty((0, 3))
    bare = poses.replace(poses_of_all, points=nothing, colours=nothing.astype(np.uint8), error=np.nan)
    poses.save_poses(tmp_path / "poses.json", tmp_path / "points.ply", bare)
    again = poses.load_poses(tmp_path / "poses.json", tmp_path / "points.ply")
    assert again.points.shape == (0, 3) and np.isnan(again.error)
    drawing.draw_poses(tmp_path / "poses.png", again)
    assert Image.open(tmp_path / "poses.png").width > 500
    (tmp_path / "poses.json").write_text("{}")
    with refused("poses.json"):
        poses.load_poses(tmp_path / "poses.json", tmp_path / "points.ply")


@pytest.fixture(scope="module")
def filmed(tmp_path_factory):
    """A capture of drawn pictures of the board, with lenses, and the true cameras in the board's frame."""
    root = tmp_path_factory.mktemp("captures") / "mug"
    true = around(4)
    for i, pose in enumerate(true):
        name = f"photos/{i}.png" if i < 3 else "stills/left.png"
        save(root / name, np.repeat(picture(pose, LENS, samples=2)[..., None], 3, axis=2))
    save(root / "photos/9.png", np.full((LENS.height, LENS.width, 3), 90, np.uint8))
    (root / "lenses.json").write_text(json.dumps({"photographs": LENS.plain(), "left": LENS.plain()}))
    (root / "capture.yaml").write_text(
        "board: {square: 0.03}\nposes: board\nlens: lenses.json\nadvanced: {longest: 720}\n"
    )
    return root, true


@pytest.fixture(scope="module")
def placed(filmed, tmp_path_factory):
    """Its settings, pictures and room."""
    root, _ = filmed
    capture = capture_folder.read_capture(root)
    result = poses.find_poses(
        capture.pictures(),
        "board",
        tmp_path_factory.mktemp("work"),
        root / capture.settings.lens,
        capture.settings.board,
    )
    pictures = pics.name_pictures(capture.pictures())
    return capture.settings, pictures, rooms.find_room(result, pictures, capture.settings)


def test_a_capture_by_the_board_alone(filmed, placed, tmp_path):
    """From files to files: cameras within 1.5 mm, one photograph without board left out, and the list of images
    projects the board's corners to where the shrunk pictures show them."""
    settings, pictures, room = placed
    assert room.poses.lost == ("photographs/9.png",) and len(room.poses.names) == 4
    centres = placement.camera_centres(filmed[1])
    wanted = np.stack([centres[:, 0] - 0.09, centres[:, 2], 0.12 - centres[:, 1]], axis=1)
    off = placement.camera_centres(room.poses.viewmats) - wanted
    assert np.linalg.norm(off, axis=1).max() < 1.5e-3
    path = tmp_path / "out/transforms.json"
    report = rooms.write_room(path, room, pictures, settings)
    assert report["registered"] == 4 and report["lost"] == ["photographs/9.png"]
    data = read_transforms(path)
    assert data["world"] == {"scale": 1.0, "offset": [0.5, 0.0, 0.5]}
    corners = boards.room_from_board(BOARD, None).apply(boards.corner_positions(BOARD)) + [0.5, 0, 0.5]
    for frame in data["frames"]:
        assert (frame["w"], frame["h"]) == (720, 540)
        view = np.linalg.inv(np.array(frame["transform_matrix"]) @ OPENGL_TO_OPENCV)
        K = np.array([[frame["fl_x"], 0, frame["cx"]], [0, frame["fl_y"], frame["cy"]], [0, 0, 1]])
        pixels = Lens(720, 540, K, np.zeros(5)).project(corners @ view[:3, :3].T + view[:3, 3])
        board = boards.find_board(np.asarray(Image.open(path.parent / frame["file_path"])), BOARD)
        off = board.pixels - pixels[board.ids]
        assert len(board.ids) >= 20 and np.abs(off).mean() < 0.15 and np.abs(off.mean(axis=0)).max() < 0.1
    drawing.draw_room(tmp_path / "room.png", room)
    with Image.open(tmp_path / "room.png") as drawn:
        assert drawn.width > 500


def test_the_floor_is_drawn_where_the_board_lies(placed, tmp_path):
    """In a single still, enlarged to the sheet's width: the axes' red line begins in the board's middle and ends 0.15 m
    along its rows."""
    settings, pictures, room = placed
    rooms.write_room(tmp_path / "transforms.json", room, pictures, settings)
    data = read_transforms(tmp_path / "transforms.json")
    (still,) = [frame for frame in data["frames"] if frame["group"] == "left"]
    (tmp_path / "one.json").write_text(json.dumps({**data, "frames": [still]}))
    drawing.draw_floor(tmp_path / "floor.png", tmp_path / "one.json")
    sheet = np.asarray(Image.open(tmp_path / "floor.png")).astype(int)
    y, x = np.nonzero((sheet[..., 0] > 150) & (sheet[..., 1] < 90) & (sheet[..., 2] < 90))
    factor = (pics.SHEET_WIDTH - 2) / still["w"]
    view = np.linalg.inv(np.array(still["transform_matrix"]) @ OPENGL_TO_OPENCV)
    ends = np.array([[0.5, 0, 0.5], [0.65, 0, 0.5]]) @ view[:3, :3].T + view[:3, 3]
    K = np.array([[still["fl_x"], 0, still["cx"]], [0, still["fl_y"], still["cy"]], [0, 0, 1]])
    wanted = Lens(still["w"], still["h"], K, np.zeros(5)).project(ends) * factor + [
        0,
        40,
    ]  # two lines of text
    red = np.stack([x, y], axis=1) + 0.5
    along = (wanted[1] - wanted[0]) / np.linalg.norm(wanted[1] - wanted[0])
    across = (red - wanted[0]) @ [-along[1], along[0]]
    reach = (red - wanted[0]) @ along
    assert len(red) > 200 and np.abs(across.mean()) < 1.5 and np.abs(across).max() < 12
    assert reach.max() == pytest.approx(np.linalg.norm(wanted[1] - wanted[0]), abs=8)


def test_scale_places_cameras_in_the_box(placed, tmp_path):
    settings, pictures, room = placed
    half = settings.model_copy(update={"scale": 0.5})
    rooms.write_room(tmp_path / "transforms.json", room, pictures, half)
    data = read_transforms(tmp_path / "transforms.json")
    got = np.array([np.array(f["transform_matrix"])[:3, 3] for f in data["frames"]])
    centres = placement.camera_centres(room.poses.viewmats)
    np.testing.assert_allclose(got, 0.5 * centres + [0.5, 0, 0.5], atol=1e-12)
    assert data["world"] == {"scale": 0.5, "offset": [0.5, 0.0, 0.5]}
    assert data["room"]["scale"] == 1.0


def test_lenses_that_do_not_fit_are_refused(filmed, tmp_path):
    root, _ = filmed
    capture = capture_folder.read_capture(root)

    def check_refused(lenses, *where):
        (tmp_path / "wrong.json").write_text(json.dumps(lenses))
        with refused("wrong.json", *where):
            poses.find_poses(capture.pictures(), "board", tmp_path, tmp_path / "wrong.json", BOARD)

    known = json.loads((root / "lenses.json").read_text())
    wide = {**known, "left": {**known["left"], "w": 1280}}
    check_refused(wide, "left")
    check_refused({"photographs": known["photographs"]})


@pytest.fixture(scope="module")
def drawn(tmp_path_factory):
    """Photographs and stills of a drawn room: files by group, and the true cameras by name in the board's frame."""
    root = tmp_path_factory.mktemp("drawn")
    true, groups = {}, {"photographs": [], "left": [], "right": []}
    for name, pose, lens in room_cameras():
        group = name.split("/")[0]
        true[name] = pose
        groups[group].append(save(root / name, room_picture(pose, lens), quality=92))
    return groups, true


@pytest.fixture(scope="module")
def poses_of_drawn(drawn, tmp_path_factory):
    pytest.importorskip("pycolmap")
    return poses.find_poses(drawn[0], "photographs", tmp_path_factory.mktemp("sfm"), seed=3, threads=2)


@pytest.mark.slow
def test_photographs_find_their_places(drawn, poses_of_drawn):
    """Of a phone and two fixed cameras, whose lenses nobody knows: within 5 mm and 0.2 degrees of the truth, the scale
    within 0.5 %, from drawn pictures with distortion, noise, and changing exposure; of the fixed cameras, whose lenses
    are 0.25 degrees off the centre, within the stated uncertainty. Points appear within a pixel of where they
    do where an object falls.
    """
    groups, true = drawn
    assert not poses_of_drawn.lost and poses_of_drawn.error < 1.0
    room = rooms.find_room(poses_of_drawn, pics.name_pictures(groups), CaptureConfig(board=BOARD))
    names, got = room.poses.names, room.poses.viewmats
    place = boards.room_from_board(BOARD, None)
    wanted = place.move_cameras(np.stack([true[name] for name in names]))
    centres = placement.camera_centres(got), placement.camera_centres(wanted)
    away = np.linalg.norm(centres[0] - centres[1], axis=1)
    trace = np.einsum("nij,nij->n", got[:, :3, :3], wanted[:, :3, :3])
    turned = np.rad2deg(np.arccos(np.clip((trace - 1) / 2, -1, 1)))
    photographed = np.array([name.startswith("photographs") for name in names])
    off = placement.fit_similarity(*centres)
    volume = place.apply(np.random.default_rng(0).uniform([-0.1, 0.0, 0.0], [0.3, 0.3, 0.4], (200, 3)))
    shifts = []
    for lens, result, truth, phone in zip(room.poses.lenses, got, wanted, photographed):
        true_lens = ROOM_LENSES["photographs" if phone else "fixed"]
        pixels = [
            seen.project(volume @ pose[:3, :3].T + pose[:3, 3])
            for seen, pose in ((lens, result), (true_lens, truth))
        ]
        inside = ((pixels[1] > 0) & (pixels[1] < [true_lens.width, true_lens.height])).all(axis=1)
        assert inside.sum() > 50
        shifts.append(np.linalg.norm(pixels[0] - pixels[1], axis=1)[inside].max())
        assert lens.K[0, 0] == pytest.approx(true_lens.K[0, 0], rel=0.005)
    up = np.rad2deg(np.arccos(off.rotation[1, 1]))
    for name, *values in zip(names, 1000 * away, turned, shifts):
        print("{}: {:.2f} mm, {:.3f} degrees, {:.2f} px".format(name, *values))
    print(f"scale {off.scale - 1:+.5f}, up {up:.4f} degrees, {room.poses.error} px, {room.board.plain()}")
    print(room.poses.unsure)
    assert away.max() < 5e-3 and turned.max() < 0.2
    for name, lens, angle in zip(names, room.poses.lenses, turned):
        if not name.startswith("photographs"):
            *centre, turn = room.poses.unsure[name]
            assert angle < 2 * turn
            assert (np.abs(lens.K[:2, 2] - ROOM_LENSES["fixed"].K[:2, 2]) < 3 * np.array(centre)).all()
    assert abs(off.scale - 1) < 5e-3 and up < 0.5
    assert max(shifts) < 1.0
    phone = room.poses.lenses[0]
    np.testing.assert_allclose(phone.K, ROOM_LENSES["photographs"].K, atol=1.0)


@pytest.mark.slow
def test_the_same_seed_finds_the_same_places(drawn, tmp_path):
    """On two threads as on one; of the upper ring of photographs and a camera whose lens is known and kept."""
    pytest.importorskip("pycolmap")
    groups = drawn[0]
    some = {
        "photographs": [f for f in groups["photographs"] if f.name.startswith("1")],
        "left": groups["left"],
    }
    known = tmp_path / "lenses.json"
    known.write_text(json.dumps({"left": ROOM_LENSES["fixed"].plain()}))
    first, second = (
        poses.find_poses(some, "photographs", tmp_path / str(threads), known, seed=3, threads=threads)
        for threads in (1, 2)
    )
    assert first.names[-1] == "left/left.jpg" and len(first.names) == 13
    np.testing.assert_array_equal(first.lenses[-1].K, ROOM_LENSES["fixed"].K)
    np.testing.assert_array_equal(first.viewmats, second.viewmats)
    np.testing.assert_array_equal(first.points, second.points)


def on_a_floor(rng, true, world):
    """Poses of a drawn reconstruction whose points lie on a floor."""
    floor = np.concatenate([rng.uniform(-0.3, 0.4, (400, 2)), np.zeros((400, 1))], axis=1)
    base = reconstruction(world.move_cameras(true))
    return poses.replace(base, points=world.apply(floor), colours=np.zeros((400, 3), np.uint8))


def test_two_points_on_the_floor_in_one_photograph_are_a_length():
    true, world = around(8), placement.Similarity(3.0, random_similarity(np.random.default_rng(7)).rotation)
    base = on_a_floor(np.random.default_rng(6), true, world)
    ends = np.array([[0.02, 0.1, 0.0], [0.20, 0.1, 0.0]])
    marks = LENS.project(ends @ true[2][:3, :3].T + true[2][:3, 3]).tolist()
    room = rooms.room_of(base, {}, CaptureConfig(length={"metres": 0.18, "ends": {"2.png": marks}}))
    assert room.room_from_world.scale * 3 == pytest.approx(1, rel=1e-6)
    assert room.scale.source == "a length on the floor" and 1e-4 < room.scale.deviation < 0.05


def test_the_length_that_gravity_gives_makes_a_room_metric():
    """Without board and length, the room has an arbitrary unit. Gravity in it states the length to enter."""
    true, world = around(8), placement.Similarity(3.0, random_similarity(np.random.default_rng(7)).rotation)
    base = on_a_floor(np.random.default_rng(6), true, world)
    room = rooms.room_of(base, {}, CaptureConfig())
    assert room.scale is None
    unit = room.room_from_world.scale * 3  # of a metre
    gravity = Gravity(np.array([0, -9.81 * unit, 0]), (0.05 * unit) ** 2 * np.eye(3), "triangulated")
    centres = placement.camera_centres(room.poses.viewmats)
    places = {name.split("/")[1]: c.tolist() for name, c in zip(base.names, centres)}
    stated = yaml.safe_load(gravity.known_length(places, "first").remedy.split("capture.yaml: ")[1])
    metric = rooms.room_of(base, {}, CaptureConfig(**stated))
    assert metric.room_from_world.scale * 3 == pytest.approx(1, rel=1e-3)
    assert metric.scale.source == "gravity in the video"
    assert metric.scale.deviation == pytest.approx(0.05 / 9.81, rel=0.05)
    one = Gravity(gravity.a, gravity.covariance, "one view in a plane", several=False, measured=False)
    assert "second camera" in one.known_length(places, "first").remedy


def test_the_floor_is_that_under_the_selected_object():
    """A table with fewer points than the floor of the room."""
    rng = np.random.default_rng(8)
    true = around(8)
    base = on_a_floor(rng, true, placement.Similarity())
    table = np.concatenate([rng.uniform(0.0, 0.2, (120, 2)), np.full((120, 1), 0.0)], axis=1)
    lower = np.concatenate([rng.uniform(-1.5, 1.5, (600, 2)), np.full((600, 1), -0.6)], axis=1)
    body = rng.uniform([0.08, 0.08, 0.0], [0.12, 0.12, 0.05], (60, 3))
    points = np.concatenate([table, lower, body])
    numbers = np.arange(len(points))
    base = poses.replace(base, points=points, sightings=(numbers,) * len(base.names))
    corners = np.array(list(np.ndindex(2, 2, 2))) * [0.04, 0.04, 0.05] + [0.08, 0.08, 0.0]
    seen = LENS.project(corners @ true[0][:3, :3].T + true[0][:3, 3])
    box = [*seen.min(axis=0).tolist(), *seen.max(axis=0).tolist()]
    heights = []
    for settings in (CaptureConfig(), CaptureConfig(object={"0.png": box})):
        room = rooms.room_of(base, {}, settings)
        heights.append(room.poses.points[:120, 1].mean())
    assert heights[0] > 0.1 and abs(heights[1]) < 1e-3
