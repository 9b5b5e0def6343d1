"""From photographs and videos of a drawn fall to masks, offsets and gravity, by real Snakemake runs."""

import json
import shutil

import numpy as np
import pytest
from PIL import Image
from scipy.spatial.transform import Rotation

from tests.support.board_pictures import BOARD, LENS, around, looking_at
from tests.support.drawn_board import Eye, Solid, write_video
from tests.support.project import copied

PAGE = "tiny/results/mug/motion.md"
SETTINGS = "board: {square: 0.03}\nposes: board\nlens: lenses.json\nadvanced: {longest: 400}\n"
MIDDLE = np.array([0.09, 0.12, 0.0])
RADII = np.array([0.045, 0.035, 0.04])
GRAVITY, RATE, COUNT, OFFSET = 9.81, 120, 40, 0.0035
HEIGHT, VELOCITY, SPIN = 0.26, np.array([0.15, -0.1, 0.0]), np.array([1.0, 2.0, 0.5])


def motion(t):
    """Centre in the board's frame, and the turn: free fall until the floor, where it stays."""
    landing = np.sqrt(2 * (HEIGHT - RADII[2]) / GRAVITY)
    t = min(t, landing)
    start = MIDDLE + (-0.02, 0.01, HEIGHT)
    return start + VELOCITY * t - (0, 0, GRAVITY * t * t / 2), Rotation.from_rotvec(SPIN * t)


@pytest.fixture(scope="module")
def drawn(tmp_path_factory):
    """Photographs with masks, stills and videos of two cameras; the second began `OFFSET` later."""
    pytest.importorskip("cv2")
    root = tmp_path_factory.mktemp("drawn")
    for name in ("photos", "stills", "videos", "masks/photographs"):
        (root / name).mkdir(parents=True)
    for k, pose in enumerate(around(6)):
        seen, mask = Eye(pose).see(Solid(MIDDLE + (0.0, 0.0, RADII[2]), Rotation.identity(), RADII))
        Image.fromarray(seen).save(root / f"photos/{k}.png")
        Image.fromarray(255 * mask).save(root / f"masks/photographs/{k}.png")
    for name, angle, offset in (("left", 0.4, 0.0), ("right", 1.9, OFFSET)):
        at = MIDDLE + (0.6 * np.cos(angle), 0.6 * np.sin(angle), 0.4)
        eye = Eye(looking_at(at, MIDDLE + (0, 0, 0.1)))
        Image.fromarray(eye.empty).save(root / f"stills/{name}.png")
        write_video(
            root / f"videos/{name}.mp4",
            [eye.see(Solid(*motion(k / RATE + offset), RADII))[0] for k in range(COUNT)],
        )
    (root / "lenses.json").write_text(
        json.dumps(dict.fromkeys(("photographs", "left", "right"), LENS.plain()))
    )
    (root / "capture.yaml").write_text(SETTINGS)
    return root


@pytest.fixture
def project(tmp_path, kernels, drawn):
    made = copied(tmp_path / "project", kernels)
    shutil.copytree(drawn, made.root / "captures/mug")
    return made


def test_masks_offset_gravity_velocity_and_spin_are_those_that_were_drawn(project):
    output = project.run(PAGE)
    results, data = project.root / "tiny/results/mug", project.root / "tiny/data/mug"
    flight = json.loads((results / "flight/first.json").read_text())
    assert "gravity is" in output
    # The room's y is up, x and z lie as the board's x and -y.
    velocity = np.array([VELOCITY[0], VELOCITY[2], -VELOCITY[1]])
    assert flight["gravity_ratio"] == pytest.approx(1, abs=0.02)
    assert flight["gravity_angle_deg"] < 0.5
    assert (
        np.linalg.norm(np.subtract(flight["v0_m_s"], velocity)) < 0.03 * GRAVITY * 0.21
    )  # of the speed at the floor
    assert flight["offsets_s"]["right"] == pytest.approx(OFFSET, abs=1e-3)  # an eighth of a frame
    spin = np.array([SPIN[0], SPIN[2], -SPIN[1]])
    assert np.linalg.norm(np.subtract(flight["spin_rad_s"], spin)) < 0.25 * np.linalg.norm(spin)
    assert min(flight["agreement"].values()) > 0.85
    photographs = json.loads((results / "masks/photographs.json").read_text())
    assert photographs["left_out"] == [] and min(photographs["agreement"].values()) > 0.85
    for file in (
        "static/transforms.json",
        "videos/first/left/transforms.json",
        "videos/first/right/transforms.json",
    ):
        assert (data / file).is_file()
    page = (project.root / PAGE).read_text()
    for file in (
        "masks/photographs.png",
        "masks/first/left.png",
        "masks/first/right.png",
        "flight/first.png",
    ):
        with Image.open(results / file) as image:
            assert image.width > 500 and f"({file})" in page
    # Nothing else is left to do. What is stated of a camera's time repeats the flight alone.
    (project.root / "captures/mug/capture.yaml").write_text(SETTINGS + "cameras: {right: {offset: 0.0035}}\n")
    assert set(project.plan(PAGE)) == {"capture_flight", "capture_motion_page"}


@pytest.mark.slow
def test_a_wrong_square_size_is_caught_by_gravity(project):
    wrong = SETTINGS.replace("0.03}", f"{1.2 * BOARD.square}}}")
    (project.root / "captures/mug/capture.yaml").write_text(wrong)
    output = project.run("tiny/results/mug/flight/first.json", succeeds=False)
    assert "board's square size is 0.8" in output and "Traceback" not in output
    assert not (project.root / "tiny/results/mug/flight/first.json").exists()


def test_bad_videos_and_masks_end_with_one_line(project):
    mug = project.root / "captures/mug"
    empty = np.asarray(Image.open(mug / "stills/left.png"))
    write_video(mug / "videos/left.mp4", [empty[:400]] * 8)
    (mug / "masks/first/right").mkdir(parents=True)
    Image.new("L", (800, 600), 255).save(mug / "masks/first/right/900.png")
    files = [f"tiny/results/mug/masks/first/{camera}.json" for camera in ("left", "right")]
    output = project.run("--keep-going", *files, succeeds=False)
    assert "left.mp4: the video is 800x400" in output and "Traceback" not in output
    assert "900.png: it must be named after a frame of the video, 0 to 39" in output
    for camera, file in zip(("left", "right"), files):
        assert not (project.root / file).exists()
        assert not (project.root / f"tiny/data/mug/videos/first/{camera}/transforms.json").exists()
