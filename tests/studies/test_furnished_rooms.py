"""Furniture, marks by hand, and troubles of cameras in the captures of rooms.yaml."""

from pathlib import Path

import numpy as np
import pytest

from neuma_lib.config.validation import validate
from neuma_lib.io.files import read_json
from neuma_lib.project.loading import read_yaml
from studies.capture_benchmark import rooms
from studies.capture_benchmark.filming import hand_path, shaken, together
from studies.capture_benchmark.furniture import FREE, RULER, furniture, marks, rolling_ball
from studies.capture_benchmark.planned import capture_settings, photograph_files
from studies.capture_benchmark.rooms import main, refusal, table
from studies.capture_benchmark.settings import DemoCapturesConfig
from studies.capture_benchmark.stage import MIDDLE, lying, photographers, solid


@pytest.fixture(scope="module")
def demo():
    settings = read_yaml("studies/capture_benchmark/rooms.yaml")["capture_benchmark"]
    return validate(DemoCapturesConfig, settings)


def test_half_of_twelve_captures_have_no_board_and_all_have_furniture(demo):
    difficulties = [item.difficulties for item in demo.objects.values()]
    assert len(difficulties) == 12 and sum(not each.board for each in difficulties) == 6
    assert all(each.furniture and each.blur for each in difficulties)
    for trouble in ("row_time", "sway", "bystander"):
        assert any(getattr(each, trouble) for each in difficulties)
    laws = [item.law.plain() for item in demo.objects.values()]
    kinds = {(law["elasticity"]["name"], law.get("plasticity", {}).get("name")) for law in laws}
    assert len(kinds) >= 7


def test_furniture_stands_on_the_floor_next_to_object_and_board(demo, monkeypatch):
    monkeypatch.setattr("studies.capture_benchmark.furniture.TEXEL", 0.02)  # fine pictures take 20 s
    for item in demo.objects.values():
        pieces = furniture(demo.room, item)
        assert len(pieces) == item.difficulties.furniture
        for number, (corners, pictures) in enumerate(pieces):
            points = np.concatenate(corners)
            assert points[:, 1].min() == pytest.approx(0) and len(pictures) == 5
            assert np.abs(points[:, [0, 2]]).max() < demo.room.half
            place = points[:, [0, 2]].mean(axis=0)
            if number % 2 == 0:
                assert np.linalg.norm(place - item.place) > FREE and points[:, 1].max() < 0.15
            for side in corners:  # the outward normal of each side
                normal = np.cross(side[1] - side[0], side[3] - side[0])
                assert normal @ (side.mean(axis=0) - [place[0], points[:, 1].max() / 2, place[1]]) < 0


def test_marks_are_those_of_object_and_ruler(demo):
    name = next(name for name, item in demo.objects.items() if not item.difficulties.board)
    files, eyes = photograph_files(demo), photographers(demo, name)
    entries = marks(demo, name, files)
    assert "board" not in capture_settings(demo, name)
    ((file, box),) = entries["object"].items()
    mesh = solid(demo.objects[name])
    pixels = eyes[files.index(file)].project(lying(demo.objects[name], mesh).apply(mesh.vertices))
    outside = np.concatenate([pixels.min(axis=0) - box[:2], box[2:] - pixels.max(axis=0)])
    assert (outside > 0).all() and outside.max() < 8
    assert len(entries["length"]["ends"]) == 2
    half = RULER[0] / 2
    ends = MIDDLE + demo.room.page + np.array([[-half, 0, 0], [half, 0, 0]])
    for file, marked in entries["length"]["ends"].items():
        off = eyes[files.index(file)].project(ends) - marked
        assert 0 < np.abs(off).max() < 8


def test_a_ball_rolls_without_slipping():
    times = np.linspace(0, 0.4, 5)
    ball = rolling_ball(times)
    assert ball.vertices[..., 1].min() == pytest.approx(0, abs=1e-3)
    lowest = ball.vertices[0, :, 1].argmin()
    assert np.linalg.norm(ball.velocities[0, lowest]) < 0.02
    moved = (ball.vertices[1] - ball.vertices[0]).mean(axis=0) / times[1]
    assert np.linalg.norm(moved) == pytest.approx(0.7, rel=1e-3)
    both = together(ball, ball)
    assert both.faces.max() == 2 * ball.vertices.shape[1] - 1 and len(both.colors) == both.vertices.shape[1]


def test_motion_blur_keeps_the_light_and_spreads_it_along_a_line():
    point = np.zeros((21, 21, 3), np.float32)
    point[10, 10] = 1
    rng = np.random.default_rng(3)
    blurred = shaken(point, 3.0, rng)[..., 0]
    assert blurred.sum() == pytest.approx(1, abs=1e-5) and blurred.max() < 0.8
    y, x = np.nonzero(blurred > 1e-6)
    spread = np.linalg.eigvalsh(np.cov(np.stack([x, y]), aweights=blurred[y, x]))
    assert spread[0] < 0.3 < spread[1]
    np.testing.assert_array_equal(shaken(point, 0.0, rng), point)


def test_a_hand_drifts_smoothly():
    path = hand_path(60, 4.0, np.random.default_rng(2))
    assert (path[0] == 0).all() and 2 < path.std() < 8
    assert np.abs(np.diff(path, axis=0)).max() < 4
    assert (hand_path(60, 0.0, np.random.default_rng(2)) == 0).all()


def test_a_table_has_a_row_for_each_capture_that_ran(demo):
    quantity = {"quantity": "E", "determined": True, "error_percent": -12.3, "error_in_std": -2.5}
    vague = {**quantity, "quantity": "nu", "determined": False}
    ran = {
        "duck_neo_hookean": {
            "end": "report",
            "scale_percent": 0.123,
            "up_deg": 0.5,
            "iou_photographs": 0.961,
            "gravity_flight": [1.02, 0.4],
            "gravity_placed": [0.99, 0.2],
            "family": "hencky (wrong)",
            "quantities": {"of the material": [quantity, vague], "on the grid": []},
            "core_seconds": 512.3,
        },
        "duck_handheld": {"end": "the camera moves during the video"},
    }
    lines = table(demo, ran).splitlines()
    assert len(lines) == 4 and "| E -12 % | 0 of 1 | 512 |" in lines[2] and "0.990, 0.2°" in lines[2]
    assert "the camera moves" in lines[3]


def test_a_refusal_is_the_message_of_the_stage_that_stopped():
    output = "[04:00] something\nERROR: mug, one, left: the camera moves (more in rooms/results/logs/a.log)\nmore\n"
    assert refusal(output) == "mug, one, left: the camera moves"
    assert refusal("a traceback").endswith("traceback")


def test_stages_can_be_run_one_after_the_other(monkeypatch, tmp_path):
    """Core seconds of the same capture add up, and files that exist are not rendered again."""
    monkeypatch.setattr(rooms, "SETTINGS", Path("studies/capture_benchmark/rooms.yaml").resolve())
    monkeypatch.chdir(tmp_path)
    capture, results = Path("rooms/captures/demo_duck_handheld"), Path("rooms/results")
    for file in ("capture.yaml", "videos/first/left.mp4", "videos/first/right.mp4"):
        (capture / file).parent.mkdir(parents=True, exist_ok=True)
        (capture / file).touch()
    asked = []

    def workflow(arguments):
        asked.append(arguments)
        last = Path(arguments[-1])
        if last.name == "report.html":
            return 2.0, "ERROR: the camera moves (more in a.log)"
        last.parent.mkdir(parents=True)
        last.touch()
        return 30.0, ""

    monkeypatch.setattr(rooms, "snakemake", workflow)
    for arguments, end in ((["--to", "motion.md"], "motion"), ([], "the camera moves")):
        monkeypatch.setattr("sys.argv", ["rooms", *arguments, "duck_handheld"])
        main()
        assert read_json(results / "rooms.json")["duck_handheld"]["end"] == end
    assert read_json(results / "rooms.json")["duck_handheld"]["core_seconds"] == 32
    assert len(asked) == 2 and not any("--snakefile" in arguments for arguments in asked)
