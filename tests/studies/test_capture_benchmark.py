"""The demo captures: cameras, poses, pictures and the comparison with the truth."""

import numpy as np
import pytest
import trimesh
import yaml
from scipy.spatial.transform import Rotation

from neuma_lib.project.capture_folder import read_capture
from studies.capture_benchmark import evaluation, filming, stage
from studies.capture_benchmark.pictures import dead_leaves, page_picture
from studies.capture_benchmark.planned import capture_settings, planned_captures
from studies.capture_benchmark.room import Moving, Shot, shoot
from studies.capture_benchmark.settings import DemoCapturesConfig
from tests.support.blends import needs_blender

G = 9.81
LENS = {"width": 160, "height": 120, "focal": 150.0, "center": [83.0, 57.5], "distortion": [-0.09, 0.03]}
OBJECT = {
    "shape": "duck",
    "size": 0.3,
    "appearance": {"colors": {"body": "#12a594"}},
    "law": {"elasticity": {"name": "fixed_corotated", "E": 4e4, "nu": 0.4}},
    "prior": "jelly",
    "heading": 40.0,
    "drops": {
        "first": {"turn": [35, 110, -20], "velocity": [0.1, -0.5, 0.2], "spin": [0.8, 1.5, -1.2]},
        "second": {"turn": [0, -75, 35], "velocity": [0.0, -0.3, 0.1], "spin": [0, 0, 1]},
    },
    "held_out": ["second"],
}
CAMERAS = {
    "left": {"place": [-0.9, 0.6, 0.9], "late": 9, "lens": LENS},
    "right": {"place": [1.2, 0.7, 0.3], "late": 2, "lens": {**LENS, "distortion": [-0.12, 0.05]}},
}
DEMO = DemoCapturesConfig(
    objects={"duck": OBJECT},
    cameras=CAMERAS,
    photographs={"lens": {**LENS, "focal": 140.0}, "rings": [3], "elevations": [40], "distances": [0.9]},
    videos={"frames": 8},
)


def test_cycles_polynomial_is_the_lens():
    for eye in [*stage.video_cameras(DEMO).values(), *stage.photographers(DEMO, "duck")]:
        row = stage.lens_row(eye.lens)
        slopes = np.linspace(0, 0.8 * eye.lens.height / eye.lens.focal, 50)
        turns = np.random.default_rng(0).uniform(0, 2 * np.pi, 50)
        points = np.stack([slopes * np.cos(turns), slopes * np.sin(turns), -np.ones(50)], axis=1)
        seen = eye.project(points @ eye.c2w[:3, :3].T + eye.c2w[:3, 3]) + row[4:6] - row[2:4] / 2
        angles = np.polyval(row[:5:-1], np.linalg.norm(seen, axis=1))
        assert np.abs(angles - np.arctan(slopes)).max() * eye.lens.focal < 0.01  # pixels
        assert (row[2:6] == np.round(row[2:6])).all()  # Blender cuts off parts of a pixel
        assert (row[4:6] >= 0).all() and (row[4:6] + row[:2] <= row[2:4]).all()


def lift(mesh, rotation):
    """Height of the centre of mass above the lowest point of a turned mesh."""
    return rotation[1] @ mesh.center_mass - (mesh.vertices @ rotation[1]).min()


def test_the_object_rests_where_it_would_stay():
    """On the floor, and any small tilt lifts its centre of mass."""
    for shape in ("duck", "cat"):
        item = DEMO.objects["duck"].model_copy(update={"shape": shape})
        mesh = stage.solid(item)
        pose = stage.lying(item, mesh)
        assert np.linalg.det(pose.rotation) == pytest.approx(1)
        assert pose.apply(mesh.vertices)[:, 1].min() == pytest.approx(0, abs=1e-12)

        level = lift(mesh, pose.rotation)
        for around in np.radians(np.arange(0, 360, 45)):
            tilt = Rotation.from_rotvec([0.03 * np.cos(around), 0, 0.03 * np.sin(around)]).as_matrix()
            assert lift(mesh, tilt @ pose.rotation) > level - 1e-9


def test_drops_start_as_stated():
    item = DEMO.objects["duck"]
    mesh = stage.solid(item)
    rest = stage.lying(item, mesh)
    for drop in item.drops.values():
        pose = stage.start(item, drop, mesh)
        points = pose.apply(mesh.vertices)
        assert points[:, 1].min() == pytest.approx(drop.height)
        np.testing.assert_allclose((points.min(axis=0) + points.max(axis=0))[[0, 2]] / 2, [0.5, 0.5])
        moved = pose.after(rest.inverse())
        np.testing.assert_allclose(moved.apply(rest.apply(mesh.vertices)), points, atol=1e-12)
        x, y, z = (Rotation.from_euler(axis, a, degrees=True) for axis, a in zip("xyz", drop.turn))
        np.testing.assert_allclose(moved.rotation, (z * y * x).as_matrix(), atol=1e-12)


def test_what_is_rendered_again_holds_the_body_and_its_shadow():
    rng = np.random.default_rng(0)
    lamps = np.array(DEMO.room.lamps) + stage.MIDDLE
    for eye in stage.video_cameras(DEMO).values():
        for low in (0.0, 0.3):
            points = stage.MIDDLE + [0, low + 0.1, 0] + rng.uniform(-0.1, 0.1, (200, 3))
            parts = filming.regions(eye, points, lamps, DEMO.room.lamp_size)
            away = rng.normal(size=(len(lamps), 400, 3)) * [1, 0, 1]
            disc = lamps[:, None] + DEMO.room.lamp_size / 2 * away / np.linalg.norm(
                away, axis=2, keepdims=True
            )
            sources = disc.reshape(-1, 1, 3)
            rays = points - sources
            shadows = (sources - rays * sources[..., 1:2] / rays[..., 1:2]).reshape(-1, 3)
            seen = eye.project(np.concatenate([points, shadows]))
            inside = ((seen >= 0) & (seen < [eye.lens.width, eye.lens.height])).all(axis=1)
            held = [((seen >= a[:2]) & (seen <= a[2:])).all(axis=1) for a in map(np.array, parts)]
            assert np.logical_or.reduce(held)[inside].all()


def test_floors_do_not_repeat():
    picture = dead_leaves(0.5, 0.4, 0.001, seed=3)[..., 0].astype(float)
    assert picture.shape == (400, 500) and picture.std() > 25
    picture -= picture.mean()
    power = np.abs(np.fft.fft2(picture)) ** 2
    same = np.fft.ifft2(power).real
    same /= same[0, 0]
    same[:60, :60] = same[-60:, :60] = same[:60, -60:] = same[-60:, -60:] = 0
    assert same.max() < 0.3


def test_a_page_has_its_squares_where_they_are_measured():
    black, white = np.array([[0.0, 0.01, 0.02, 0.01]]), np.array([[0.005, 0.01, 0.01, 0.005]])
    page = page_picture(black, white, (0.03, 0.02), (0.05, 0.04), 0.001)[..., 0] < 100
    expected = np.zeros((40, 50), bool)
    expected[10:20, 10:30] = True  # margins of 10 pixels; rows count from the top
    expected[15:20, 15:25] = False
    np.testing.assert_array_equal(page, expected)


def test_the_plan_is_what_lies_there(tmp_path):
    plan = planned_captures(DEMO, tmp_path)["demo_duck"]
    for file in (
        *plan.photographs,
        *plan.stills.values(),
        *(v for t in plan.takes.values() for v in t.values()),
    ):
        file.parent.mkdir(parents=True, exist_ok=True)
        file.touch()
    (plan.folder / "capture.yaml").write_text(yaml.safe_dump(capture_settings(DEMO, "duck")))
    assert read_capture(plan.folder) == plan
    text = str(capture_settings(DEMO, "duck"))
    assert all(word not in text for word in ("spin", "turn", "velocity", "late", "offset", "law", "E'"))


# ------------------------------------------------------------------------------------- comparison


def box_motion(times, velocity, spin, center):
    """A drop of 200 points that fly freely, as `Truth`, and their pose at a time."""
    rng = np.random.default_rng(1)
    points = rng.uniform(-0.1, 0.1, (200, 3))
    points -= points.mean(axis=0)

    def at(time):
        shift = center + np.array(velocity) * time - [0, G * time * time / 2, 0]
        return Rotation.from_rotvec(np.array(spin) * time).apply(points) + shift

    x = np.stack([at(time) for time in times])
    return evaluation.Truth(np.asarray(times), x, np.ones(200), x[:, ::2]), at


def known_and_truth():
    velocity, spin, center = [0.2, -0.5, 0.1], [1.0, 2.0, -0.5], np.array([0.5, 0.6, 0.5])
    truth, at = box_motion(np.arange(60) / 240, velocity, spin, center)
    turn = Rotation.from_rotvec([0.4, 1.9, -0.3]).as_matrix()
    known = {
        "gravity_m_s2": [0, -G, 0],
        "cameras": {"a": {"offset_s": 0.003}, "b": {"offset_s": 0.001}},
        "drops": {
            "first": {
                "rotation": turn.tolist(),
                "translation": [0.1, 0.3, 0.2],
                "center_m": center.tolist(),
                "v0_m_s": velocity,
            }
        },
    }
    return known, truth, at, np.array(spin)


def test_a_registration_that_is_right_is_not_off():
    known, truth, _, spin = known_and_truth()
    t0 = 0.031
    time = t0 + 0.003
    center = np.array([0.5, 0.6, 0.5]) + np.array([0.2, -0.5, 0.1]) * time - [0, G * time**2 / 2, 0]
    drop = known["drops"]["first"]
    turn = Rotation.from_rotvec(spin * time).as_matrix()
    photographed = np.array(drop["rotation"]).T @ (np.array([0.5, 0.6, 0.5]) - drop["translation"])
    rotation = turn @ drop["rotation"]
    results = {
        "t0_s": t0,
        "rotation": rotation.tolist(),
        "translation": (center - rotation @ photographed).tolist(),
        "offsets_s": {"a": 0.0, "b": -0.002},
        "gravity_m_s2": [0, -G, 0],
        "gravity_ratio": 1.0,
    }
    velocity = {"v0": [0.2, -0.5 - G * time, 0.1], "angular_velocity": spin.tolist()}
    rows = {
        row.what: row for row in evaluation.compare_registration(results, velocity, known, truth, "first")
    }
    assert all(row.value < 1e-3 for row in rows.values()), rows
    assert all(row.reached for row in rows.values() if row.goal)
    results["translation"][0] += 0.004
    tilt = Rotation.from_rotvec(np.radians([0, 0, 2.0])).as_matrix()
    worse = {
        row.what: row for row in evaluation.compare_registration(results, velocity, known, truth, "first")
    }
    assert worse["registration, place"].value == pytest.approx(4) and not worse["registration, place"].reached
    results["rotation"] = (tilt @ rotation).tolist()
    results["gravity_m_s2"] = (tilt @ [0, -G, 0]).tolist()
    worse = {
        row.what: row for row in evaluation.compare_registration(results, velocity, known, truth, "first")
    }
    down = worse["direction of gravity, from the placed object"]
    for tilted in (worse["registration, turn"], down):
        assert tilted.value == pytest.approx(2) and not tilted.reached


def test_tracer_errors():
    _, truth, at, _ = known_and_truth()
    start = 0.02
    times = np.arange(20) / 500
    x = np.stack([at(start + time) for time in times])
    # Between frames the truth is taken to go straight, over 1/240 s: a t^2 / 8.
    assert evaluation.tracer_error(x, times, truth, start) < (G + 0.1 * 5.3) / 240**2 / 8
    moved = x + np.linspace(0, 1, 20)[:, None, None] * [0.0, 0.03, 0.0]
    expected = 0.03 * np.sqrt(np.mean(np.linspace(0, 1, 20)[1:] ** 2))
    assert evaluation.tracer_error(moved, times, truth, start) == pytest.approx(expected, rel=1e-3)


def test_a_flight_that_is_right_is_not_off():
    known, truth, _, spin = known_and_truth()
    time = 0.05 + 0.003
    flight = {
        "start_s": 0.05,
        "v0_m_s": [0.2, -0.5 - G * time, 0.1],
        "gravity_m_s2": [0, -G, 0],
        "gravity_ratio": 1.0,
        "offsets_s": {"a": 0.0, "b": -0.0015},
        "spin_rad_s": spin.tolist(),
    }
    rows = {row.what: row.value for row in evaluation.compare_flight(flight, known, truth, "first")}
    assert rows.pop("offset of b, from the fall") == pytest.approx(0.5)
    assert max(rows.values()) < 1e-3


def test_cameras_that_are_right_are_not_off():
    eyes = stage.video_cameras(DEMO)
    photographs = {f"{k:03}": eye.plain() for k, eye in enumerate(stage.photographers(DEMO, "duck"))}
    frames = [{"group": name, "file_path": f"{name}/{name}.png", **eye.plain()} for name, eye in eyes.items()]
    frames += [
        {"group": "photographs", "file_path": f"photographs/{k}.png", **v} for k, v in photographs.items()
    ]
    cameras = {name: eye.plain() for name, eye in eyes.items()}
    rows = {row.what: row.value for row in evaluation.compare_cameras(frames, photographs, cameras)}
    assert max(rows.values()) < 1e-5
    for frame in frames:
        pose = np.array(frame["transform_matrix"])
        pose[:3, 3] = 1.01 * pose[:3, 3]
        frame["transform_matrix"] = pose.tolist()
    rows = {row.what: row.value for row in evaluation.compare_cameras(frames, photographs, cameras)}
    assert rows["scale, from the cameras"] == pytest.approx(1.0, rel=0.02)
    assert rows["up, from the cameras"] < 1e-5


def test_the_silhouette_of_a_ball():
    """Where rays pass within its radius, but for the quarter of a pixel at its edge."""
    pytest.importorskip("cv2")
    eye = stage.video_cameras(DEMO)["left"]
    ball = trimesh.creation.icosphere(subdivisions=4, radius=0.1)
    center = np.array([0.5, 0.2, 0.5])
    lens = evaluation.true_lens(eye.plain())
    drawn = evaluation.silhouette(ball.vertices + center, ball.faces, eye.c2w, lens)
    x, y = np.meshgrid(np.arange(lens.width) + 0.5, np.arange(lens.height) + 0.5)
    flat = lens.directions(np.stack([x.ravel(), y.ravel()], axis=1))
    rays = np.stack([flat[:, 0], -flat[:, 1], -np.ones(len(flat))], axis=1) @ eye.c2w[:3, :3].T
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    to = center - eye.c2w[:3, 3]
    expected = np.linalg.norm(np.cross(rays, to), axis=1).reshape(drawn.shape) < 0.1
    radius = np.sqrt(expected.sum() / np.pi)
    assert (drawn != expected).sum() < 2 * np.pi * radius * 0.25


# --------------------------------------------------------------------------------------- pictures


@pytest.fixture(scope="module")
def room():
    """A small room with the board, with coarse pictures on floor and walls."""
    pytest.importorskip("cv2")
    from neuma_lib.capture.calibration.board import black_rectangles

    board = DEMO.room.board
    texel = board.square / 112
    size = tuple(n * board.square for n in board.squares)
    page = page_picture(*black_rectangles(board), size, (0.297, 0.42), texel)
    coarse = DEMO.room.model_copy(update={"texels": 256})
    printed = page.shape[1] * texel, page.shape[0] * texel
    return filming.scenery(coarse, page, printed, DEMO.objects["duck"])


@needs_blender
def test_rendered_pictures_are_where_the_truth_is(room):
    """Corners of the board, and the silhouette of a body that moves, in pictures of a lens with distortion."""
    from neuma_lib.capture.calibration.board import corner_positions, find_board

    lens = DEMO.cameras["left"].lens.resized(2.5)
    middle = stage.MIDDLE + np.array(DEMO.room.page)
    eye = stage.Eye(stage.looking(middle + [0.25, 0.55, 0.3], middle + [0.07, 0.0, -0.05], roll=0.3), lens)
    mesh = trimesh.creation.icosphere(subdivisions=3, radius=0.07)
    rest = mesh.vertices + stage.MIDDLE + [-0.02, 0.12, -0.05]
    body = Moving(
        rest[None], np.zeros((1, *rest.shape)), mesh.faces, np.tile([0.9, 0.1, 0.1], (len(rest), 1))
    )
    row = stage.lens_row(lens)
    empty, full = shoot(room, body, [Shot(eye.c2w, row, -1), Shot(eye.c2w, row, 0)], samples=8)
    rng = np.random.default_rng(0)
    result = find_board(filming.developed(empty, 1.0, rng), DEMO.room.board)
    board = DEMO.room.board
    flat = corner_positions(board)[result.ids] - [*np.multiply(board.squares, board.square / 2), 0]
    true = eye.project(middle + np.stack([flat[:, 0], 0 * flat[:, 0] + filming.PAPER, -flat[:, 1]], axis=1))
    assert len(result.ids) >= 20
    off = result.pixels - true
    assert np.sqrt((off**2).sum(axis=1).mean()) < 0.3 and np.linalg.norm(off.mean(axis=0)) < 0.1
    red = (full[..., 0] > 4 * full[..., 1]) & (full[..., 0] > 0.02)
    silhouette = evaluation.silhouette(rest, mesh.faces, eye.c2w, evaluation.true_lens(eye.plain()))
    assert evaluation.iou(red, silhouette) > 0.97


@needs_blender
def test_a_body_is_blurred_over_the_exposure(room):
    """A straight way of length L, around the frame's time, adds L^2 / 12 to the variance of where the body is seen."""
    eye = next(iter(stage.video_cameras(DEMO).values()))
    mesh = trimesh.creation.box((0.1, 0.1, 0.1))
    rest = (mesh.vertices + stage.MIDDLE + [0, 0.3, 0])[None]
    speed, exposure = 20.0, 0.005
    velocities = np.broadcast_to([0.0, -speed, 0.0], rest.shape)
    body = Moving(rest, velocities, mesh.faces, np.tile([1.0, 0.0, 0.0], (8, 1)))
    region = (50, 28, 126, 76)  # without the floor, which is red below the body
    shots = [Shot(eye.c2w, stage.lens_row(eye.lens), frame, region) for frame in (-1, 0)]
    moments = []
    for duration in (0.0, exposure):
        empty, seen = shoot(room, body, shots, samples=16, exposure=duration)
        redder = (seen - empty)[..., 0] - (seen - empty)[
            ..., 1
        ]  # in proportion to how much of a pixel is covered
        share = redder.sum(axis=1) / redder.sum()
        rows = np.arange(len(share)) + 0.5
        moments.append((share @ rows, share @ rows**2 - (share @ rows) ** 2))
    ends = eye.project(stage.MIDDLE + np.array([[0, 0.3 - 0.05, 0], [0, 0.3 + 0.05, 0]]))
    (place, spread), (blurred_place, blurred_spread) = moments
    assert abs(blurred_place - place) < 0.5
    assert np.sqrt(12 * (blurred_spread - spread)) == pytest.approx(np.ptp(ends[:, 1]), rel=0.15)


@needs_blender
def test_a_rolling_shutter_shears_what_moves_across_the_picture(room):
    """Lower rows are read later, so that a post which moves to the right leans by its way in a row time."""
    eye = next(iter(stage.video_cameras(DEMO).values()))
    eye = stage.Eye(eye.c2w, eye.lens.resized(3))
    mesh = trimesh.creation.box((0.06, 0.4, 0.06))
    rest = (mesh.vertices + stage.MIDDLE + [0, 0.26, 0])[None]
    speed, row_time = 15.0, 2e-5
    right = eye.c2w[:3, 0]
    body = Moving(
        rest, np.broadcast_to(speed * right, rest.shape), mesh.faces, np.tile([1.0, 0.0, 0.0], (8, 1))
    )
    ends = eye.project(stage.MIDDLE + np.array([[0, 0.2, 0], [0, 0.44, 0]]))  # above the floor in the picture
    rows = slice(int(ends[:, 1].min()), int(ends[:, 1].max()))
    region = (0, rows.start, eye.lens.width, rows.stop)
    shots = [Shot(eye.c2w, stage.lens_row(eye.lens), frame, region) for frame in (-1, 0)]
    leans = []
    for time in (0.0, row_time):
        empty, full = shoot(room, body, shots, samples=8, exposure=2e-4, row_time=time)
        red = ((full - empty)[..., 0] - (full - empty)[..., 1]).clip(0)
        middles = red @ (np.arange(eye.lens.width) + 0.5) / red.sum(axis=1)
        leans.append(np.polyfit(np.arange(len(middles)), middles, 1)[0])
    distance = np.linalg.norm(stage.MIDDLE + [0, 0.32, 0] - eye.c2w[:3, 3])
    expected = speed * row_time * eye.lens.focal / distance
    assert leans[1] - leans[0] == pytest.approx(expected, rel=0.1)
