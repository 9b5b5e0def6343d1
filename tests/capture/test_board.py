"""The printed board and the lens: printing, detection and calibration."""

import re

import numpy as np
import pytest

from neuma_lib.capture.calibration import board as boards
from neuma_lib.capture.calibration import lens as lenses
from neuma_lib.capture.calibration import placement
from neuma_lib.config.capture import BoardConfig
from neuma_lib.errors import InputError
from tests.support.board_pictures import BOARD, LENS, around, picture, print_texture
from tests.support.errors import refused
from tests.support.similarities import exact, random_similarity

cv2 = pytest.importorskip("cv2")

DICTIONARIES = ("DICT_4X4_100", "DICT_5X5_100", "DICT_6X6_100", "DICT_APRILTAG_36h11")


def test_directions_undo_projection():
    """And both agree with OpenCV, whose pixels lack half a one."""
    rng = np.random.default_rng(0)
    points = np.concatenate([rng.uniform(-0.5, 0.5, (200, 2)), np.ones((200, 1))], axis=1)
    pixels = LENS.project(points)
    np.testing.assert_allclose(LENS.directions(pixels), points[:, :2], atol=1e-9)
    K = LENS.K - np.array([[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]])
    theirs = cv2.projectPoints(points, np.zeros(3), np.zeros(3), K, LENS.distortion)[0].reshape(-1, 2)
    np.testing.assert_allclose(pixels, theirs + 0.5, atol=1e-9)


def test_undistorted_pictures_are_those_of_the_pinhole():
    """A smooth picture, seen through either lens, agrees after undistortion; a shift of half a pixel would not."""

    def scene(directions):
        return 128 + 100 * np.sin(9 * directions[:, 0] + 1) * np.cos(11 * directions[:, 1])

    x, y = np.meshgrid(np.arange(LENS.width) + 0.5, np.arange(LENS.height) + 0.5)
    pixels = np.stack([x.ravel(), y.ravel()], axis=1)
    shape = LENS.height, LENS.width
    plain = LENS.pinhole()
    seen = scene(LENS.directions(pixels)).reshape(shape).astype(np.float32)
    wanted = scene(plain.directions(pixels)).reshape(shape)
    got = LENS.undistort(seen)
    # The gradient is at most 100 * 11 / 700 = 1.6 a pixel: remap's tables of 1/32 px cost 0.03; half a pixel 0.8.
    assert np.abs(got - wanted)[2:-2, 2:-2].max() < 0.06
    corners = plain.directions(np.array([[0.5, 0.5], [799.5, 0.5], [0.5, 599.5], [799.5, 599.5]]))
    back = LENS.project(np.concatenate([corners, np.ones((4, 1))], axis=1))
    assert (back > -1.5).all() and (back < [801.5, 601.5]).all()  # it sees what the lens saw


def test_lenses_are_written_and_read():
    again = lenses.read_lens(LENS.plain(), "here")
    np.testing.assert_array_equal(again.K, LENS.K)
    np.testing.assert_array_equal(again.distortion, LENS.distortion)
    for change in ({"fl_x": -1}, {"k1": float("nan")}, {"w": 1.5}, {"cx": "a"}):
        with refused("here", next(iter(change))):
            lenses.read_lens({**LENS.plain(), **change}, "here")


@pytest.mark.parametrize("model", lenses.COLMAP_MODELS)
def test_lenses_of_colmap(model):
    """Its own projection and ours agree, with its own pixels."""
    pycolmap = pytest.importorskip("pycolmap")
    values = {
        "f": 700,
        "fx": 690,
        "fy": 710,
        "cx": 390,
        "cy": 310,
        "k1": -0.1,
        "k2": 0.03,
        "p1": 1e-3,
        "p2": -2e-3,
    }
    parameters = [values[name] for name in lenses.COLMAP_MODELS[model]]
    camera = pycolmap.Camera(model=model, width=800, height=600, params=parameters)
    points = np.concatenate([np.random.default_rng(0).uniform(-0.4, 0.4, (50, 2)), np.ones((50, 1))], axis=1)
    ours = lenses.lens_of_colmap(model, parameters, 800, 600).project(points)
    np.testing.assert_allclose(ours, camera.img_from_cam(points), atol=1e-9)


@pytest.mark.parametrize("dictionary", DICTIONARIES)
def test_print_is_opencvs_board(dictionary):
    """Rectangle by rectangle, and the corners' numbers and places, but for the axes."""
    board = BoardConfig(square=0.03, dictionary=dictionary)
    known = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, dictionary))
    theirs = cv2.aruco.CharucoBoard(board.squares, board.square, board.square * board.marker, known)
    pixels = 16 * (known.markerSize + 2)
    drawn = theirs.generateImage((6 * pixels, 8 * pixels), marginSize=0, borderBits=1)
    np.testing.assert_array_equal(print_texture(board, pixels), drawn)
    down = np.asarray(theirs.getChessboardCorners(), np.float64)
    np.testing.assert_allclose(boards.corner_positions(board), [0, 0.24, 0] + down * [1, -1, 1], atol=1e-7)


def test_page_has_true_size(tmp_path):
    """The page is A4, a square 30 mm, the ruler 100 mm, in PDF's points of 1/72 inch; and twice the same bytes."""
    import matplotlib

    with matplotlib.rc_context({"pdf.compression": 0}):
        boards.print_board(tmp_path / "a.pdf", BOARD)
        boards.print_board(tmp_path / "b.pdf", BOARD)
    content = (tmp_path / "a.pdf").read_bytes()
    assert content == (tmp_path / "b.pdf").read_bytes()
    page = np.array(re.search(rb"/MediaBox \[ ([^\]]+) \]", content)[1].split(), float)
    point = 25.4 / 72
    np.testing.assert_allclose(page * point, [0, 0, 210, 297], atol=0.01)
    corner = rb"([\d.]+) ([\d.]+) [ml]\n"
    boxes = [np.array(m, float).reshape(4, 2) * point for m in re.findall(corner * 4 + rb"h", content)]
    sizes = np.array([box.max(axis=0) - box.min(axis=0) for box in boxes])
    assert (np.abs(sizes - 30) < 0.01).all(axis=1).sum() == 24  # half of 6 x 8 squares
    assert (np.abs(sizes - 22.5) < 0.01).all(axis=1).sum() == 24  # markers
    assert (np.abs(sizes[:, 0] - 100) < 0.01).sum() == 1
    squares = np.concatenate([b for b, s in zip(boxes, sizes) if (np.abs(s - 30) < 0.01).all()])
    np.testing.assert_allclose(squares.max(axis=0) - squares.min(axis=0), [180, 240], atol=0.01)
    assert squares.min() > 9.9 and (squares.max(axis=0) < [200.1, 287.1]).all()


def test_a_board_that_does_not_fit_the_page(tmp_path):
    with pytest.raises(InputError, match="the maximum is 31 mm"):
        boards.print_board(tmp_path / "a.pdf", BoardConfig(square=0.032))
    boards.print_board(tmp_path / "a.pdf", BoardConfig(square=0.04), "A3")
    with refused("paper"):
        boards.print_board(tmp_path / "a.pdf", BOARD, "A5")


@pytest.mark.parametrize("view", [0, 2])
def test_corners_are_found_below_a_pixel_and_give_the_pose(view):
    """0.1 px at 700 px of focal length and 0.7 m are 0.1 mm; half a pixel, or y down, would stand out."""
    pose = around(5)[view]
    board = boards.find_board(picture(pose), BOARD)
    assert len(board.ids) >= 33  # of 35
    truth = exact([pose])[0]
    off = board.pixels - truth.pixels[np.searchsorted(truth.ids, board.ids)]
    assert (
        np.abs(off).max() < 0.3 and np.sqrt((off**2).mean()) < 0.1 and np.abs(off.mean(axis=0)).max() < 0.05
    )
    got, error = boards.board_pose(board, BOARD, LENS, "picture")
    assert error < 0.15
    centre = placement.camera_centres(np.stack([pose, got]))
    assert np.linalg.norm(centre[0] - centre[1]) < 1e-3
    assert np.arccos((np.trace(got[:3, :3] @ pose[:3, :3].T) - 1) / 2) < np.deg2rad(0.1)


def test_pose_of_exact_corners_is_exact():
    poses = around(6)
    for result, pose in zip(exact(poses), poses):
        got, error = boards.board_pose(result, BOARD, LENS, "picture")
        np.testing.assert_allclose(got, pose, atol=1e-6)
        assert error < 1e-4


def test_pictures_without_board_and_from_below_are_refused():
    grey = np.full((600, 800, 3), 127, np.uint8)
    nothing = boards.find_board(grey, BOARD)
    assert len(nothing.ids) == 0 and nothing.pixels.shape == (0, 2)
    with refused("still.jpg"):
        boards.board_pose(nothing, BOARD, LENS, "still.jpg")
    result = exact(around(1))[0]
    row = boards.Detection(result.ids[:5], result.pixels[:5])
    with pytest.raises(InputError, match="still.jpg: 5 corners"):
        boards.board_pose(row, BOARD, LENS, "still.jpg")
    mirrored = boards.Detection(result.ids, result.pixels * [-1, 1] + [800, 0])
    with pytest.raises(InputError, match="do not fit a flat board"):
        boards.board_pose(mirrored, BOARD, LENS, "still.jpg")
    other = BoardConfig(square=0.03, squares=(5, 8))
    wrong = boards.Detection(result.ids[result.ids < 28], result.pixels[result.ids < 28])
    with pytest.raises(InputError, match="Check board.squares"):
        boards.board_pose(wrong, other, LENS, "still.jpg")


def test_similarity_from_exact_corners_is_exact():
    """Cameras in a world of another scale and frame come back to the board's, and see what they saw."""
    rng = np.random.default_rng(1)
    truth = random_similarity(rng)
    poses = around(6)
    world = truth.inverse().move_cameras(poses)
    fit = boards.fit_board(exact(poses), [LENS] * 6, world, BOARD)
    np.testing.assert_allclose(fit.board_from_world.scale, truth.scale, rtol=1e-8)
    np.testing.assert_allclose(fit.board_from_world.rotation, truth.rotation, atol=1e-8)
    np.testing.assert_allclose(fit.board_from_world.move_cameras(world), poses, atol=1e-7)
    assert fit.residual < 1e-8 and fit.pictures == 6 and len(fit.corners) == 35


def test_similarity_from_noisy_corners():
    """Corners off by 0.3 px, seen 8 times from 0.68 m: each lies within about 0.3 * 0.68 / 700 / sqrt(8) = 0.1 mm
    across the rays; 35 of them give the scale of a board of 0.09 m spread to 0.1 / sqrt(35) / 90 = 2e-4."""
    rng = np.random.default_rng(2)
    poses = around(8)
    results = [boards.Detection(f.ids, f.pixels + rng.normal(0, 0.3, f.pixels.shape)) for f in exact(poses)]
    fit = boards.fit_board(results, [LENS] * 8, poses, BOARD)
    assert abs(fit.board_from_world.scale - 1) < 4 * 2e-4
    assert 0.05e-3 < fit.residual < 0.4e-3 and fit.flatness <= fit.residual
    up = fit.board_from_world.rotation[2]
    assert np.arccos(up[2]) < np.deg2rad(0.2)


def test_a_moved_board_or_too_few_views_are_refused():
    poses = around(6)
    result = exact(poses)
    with pytest.raises(InputError, match="board: it is visible in 1 of 6"):
        nothing = boards.Detection(np.empty(0, int), np.empty((0, 2)))
        boards.fit_board([result[0]] + [nothing] * 5, [LENS] * 6, poses, BOARD)
    with refused("board"):
        boards.fit_board(result[:1] * 2, [LENS] * 2, poses[[0, 0]], BOARD)
    bent = BoardConfig(square=0.03, squares=(7, 8))  # numbers stand for other places
    with refused("board.squares"):
        boards.fit_board(result, [LENS] * 6, poses, bent)


def test_room_is_upright():
    """The board's middle is the origin, its z is up, x stays; a thick print lies above the floor."""
    room = boards.room_from_board(BoardConfig(square=0.03, thickness=0.004), None)
    middle = np.array([0.09, 0.12, 0.0])
    np.testing.assert_allclose(room.apply(middle[None])[0], [0, 0.004, 0], atol=1e-15)
    np.testing.assert_allclose(room.rotation @ [0, 0, 1], [0, 1, 0])
    np.testing.assert_allclose(room.rotation @ [1, 0, 0], [1, 0, 0])
    assert np.linalg.det(room.rotation) == pytest.approx(1)
    moved = boards.room_from_board(BOARD, (0.5, 0.0))
    np.testing.assert_allclose(moved.apply(np.array([[0.5, 0.0, 0.1]]))[0], [0, 0.1, 0], atol=1e-15)


def test_similarities_compose_and_invert():
    rng = np.random.default_rng(3)
    a, b = random_similarity(rng), random_similarity(rng)
    points = rng.normal(size=(20, 3))
    np.testing.assert_allclose(a.after(b).apply(points), a.apply(b.apply(points)), atol=1e-12)
    np.testing.assert_allclose(a.inverse().apply(a.apply(points)), points, atol=1e-12)
    poses = around(3)
    centres = placement.camera_centres(poses)
    np.testing.assert_allclose(placement.camera_centres(a.move_cameras(poses)), a.apply(centres), atol=1e-12)
    fitted = placement.fit_similarity(points, a.apply(points))
    np.testing.assert_allclose(fitted.apply(points), a.apply(points), atol=1e-12)
    with refused("source"):
        placement.fit_similarity(np.outer([0, 1, 2, 3], [1.0, 2, 3]), np.outer([0, 1, 2, 3], [1.0, 0, 0]))


def test_triangulation():
    poses = around(3)
    point = np.array([0.05, 0.1, 0.07])
    seen = poses[:, :3, :3] @ point + poses[:, :3, 3]
    got, angle = placement.triangulate(poses, seen[:, :2] / seen[:, 2:])
    np.testing.assert_allclose(got, point, atol=1e-12)
    rays = point - placement.camera_centres(poses)
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    assert angle == pytest.approx(np.arccos((rays @ rays.T).min()), abs=1e-9)
    assert np.isnan(placement.triangulate(poses[[0, 0]], (seen[:, :2] / seen[:, 2:])[[0, 0]])[0]).all()


def test_a_known_length_gives_the_scale():
    """A rod of 12 cm, in a world 2.5 times as large."""
    poses = placement.Similarity(2.5, np.eye(3), np.zeros(3)).move_cameras(around(3))
    ends = 2.5 * np.array([[0.02, 0.1, 0.0], [0.02, 0.1, 0.12]])
    seen = np.einsum("nij,ej->nei", poses[:, :3, :3], ends) + poses[:, None, :3, 3]
    directions = seen[..., :2] / seen[..., 2:]
    assert placement.scale_from_length(poses, directions, 0.12) == pytest.approx(1 / 2.5, rel=1e-9)
    with refused("length.ends"):
        placement.scale_from_length(poses[[0, 0]], directions[[0, 0]], 0.12)


def test_floor_is_found_among_other_points():
    """A third of the points lie on the floor, within 1 mm; the rest are the object and another plane, the wall."""
    rng = np.random.default_rng(4)
    true = random_similarity(rng)
    floor = np.stack([rng.uniform(-1, 1, 300), rng.normal(0, 1e-3, 300), rng.uniform(-1, 1, 300)], axis=1)
    body = rng.uniform([-0.2, 0, -0.2], [0.2, 0.4, 0.2], (400, 3))
    wall = np.stack([rng.uniform(-1, 1, 200), rng.uniform(0, 1, 200), np.full(200, 1.0)], axis=1)
    cameras = np.array([[1, 0.5, 0], [0, 0.6, 0.8], [-1, 0.7, 0.0], [0, 0.5, -1.0]])
    points = np.concatenate([floor, body, wall])
    point, normal, share = placement.fit_floor(
        true.apply(points), true.apply(cameras), 4e-3 * true.scale, seed=0
    )
    assert np.arccos(normal @ true.rotation[:, 1]) < 5 * 1e-3 / np.sqrt(
        300 / 3
    )  # tilt of a line fit on [-1, 1]
    assert abs(true.inverse().apply(point[None])[0, 1]) < 1e-3 and 0.3 < share < 0.4
    level = placement.upright(normal, point)
    assert np.linalg.det(level.rotation) == pytest.approx(1)
    np.testing.assert_allclose(level.rotation @ normal, [0, 1, 0], atol=1e-12)
    with refused("photographs"):
        placement.fit_floor(rng.normal(size=(500, 3)), cameras, 1e-4, seed=0)
    with refused("photographs"):
        placement.fit_floor(floor[:2], cameras, 1e-3, seed=0)


def test_the_outline_of_the_board_is_a_square_larger_than_its_squares():
    pose, K = around(1)[0], np.array([[700.0, 0, 400], [0, 700, 300], [0, 0, 1]])
    room = boards.room_from_board(BOARD, None)
    in_room = np.eye(4)  # room to camera, through the board's frame
    back = room.inverse()
    in_room[:3, :3] = pose[:3, :3] @ back.rotation
    in_room[:3, 3] = pose[:3, :3] @ back.translation + pose[:3, 3]
    result = boards.board_outline(BOARD, None, in_room, K)
    s, (columns, rows) = BOARD.square, BOARD.squares
    corner = pose[:3, :3] @ (-s, -s, 0) + pose[:3, 3]
    opposite = pose[:3, :3] @ ((columns + 1) * s, (rows + 1) * s, 0) + pose[:3, 3]
    for k, point in ((0, corner), (2, opposite)):
        seen = K @ point
        np.testing.assert_allclose(result[k], seen[:2] / seen[2])
    in_room[2] *= -1
    assert boards.board_outline(BOARD, None, in_room, K) is None
