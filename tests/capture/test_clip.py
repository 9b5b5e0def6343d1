"""One video of a fall and a rebound, of which nothing is known but the width of the ball."""

import json

import numpy as np
import pytest

from tests.support.drawn_falls import HEIGHT, WIDTH, ellipse, texture
from tests.support.films import ffmpeg

pytest.importorskip("cv2")

from neuma_lib.capture.clip import analyse_clip  # noqa: E402
from neuma_lib.cli import main  # noqa: E402
from tests.support.errors import refused  # noqa: E402

RATE, PIXELS, RADIUS, RESTITUTION = 60, 2700.0, 13.0, 0.7
DIAMETER = 9.81 * 2 * RADIUS / PIXELS


def motion(t, floor=200.0, top=40.0):
    """Centre of the ball [px]: a fall from rest and one rebound."""
    landing = np.sqrt(2 * (floor - top) / PIXELS)
    if t < landing:
        return 60 + 90 * t, top + PIXELS * t * t / 2
    up, later = RESTITUTION * PIXELS * landing, t - landing
    return 60 + 90 * t, floor - up * later + PIXELS * later**2 / 2


def write(path, count, shake=0):
    rng = np.random.default_rng(0)
    empty, pictures = texture(), []
    for k in range(count):
        seen = np.where(ellipse(motion(k / RATE), RADIUS, RADIUS)[..., None], (225, 70, 40), empty)
        seen = np.roll(seen, round(shake * np.sin(k)), axis=1) + rng.normal(0, 2, empty.shape)
        pictures.append(np.clip(seen, 0, 255).astype(np.uint8))
    options = ("-f", "rawvideo", "-pix_fmt", "rgb24", "-s", f"{WIDTH}x{HEIGHT}", "-r", RATE, "-i", "-")
    ffmpeg(*options, "-c:v", "libx264", "-crf", 10, path, content=np.stack(pictures).tobytes())
    return path


@pytest.fixture(scope="module")
def video(tmp_path_factory):
    return write(tmp_path_factory.mktemp("clip") / "ball.mp4", 46)


def test_gravity_width_and_rebound_are_those_that_were_drawn(video, tmp_path, capsys):
    assert main(["clip", str(video), str(tmp_path / "ball"), "--diameter", str(DIAMETER)]) == 0
    report = json.loads((tmp_path / "ball/clip.json").read_text())
    fall, rise = report["flights"]
    assert fall["gravity_ratio"] == pytest.approx(1, abs=0.03) and fall["gravity_angle_deg"] < 1.5
    assert rise["gravity_ratio"] == pytest.approx(1, abs=0.06)
    assert report["rebounds"][0]["restitution"] == pytest.approx(RESTITUTION, abs=0.05)
    page = (tmp_path / "ball/clip.md").read_text()
    for file in ("masks.png", "flights.png"):
        assert (tmp_path / "ball" / file).is_file() and f"({file})" in page
    assert "restitution before" in capsys.readouterr().out
    unknown = analyse_clip(video, tmp_path / "unknown")["flights"][0]
    assert unknown["diameter_m"] == pytest.approx(DIAMETER, rel=0.03)


def test_videos_without_a_fixed_camera_or_a_flight_are_refused_with_a_picture(tmp_path):
    with refused("shaken.mp4", problem="the camera moves", remedy="masks.failed.png"):
        analyse_clip(write(tmp_path / "shaken.mp4", 20, shake=6), tmp_path / "out")
    assert (tmp_path / "out/masks.failed.png").is_file()
    with refused("short.mp4"):
        analyse_clip(write(tmp_path / "short.mp4", 4), tmp_path / "short")
