"""One video of a fall and a rebound, of which nothing is known but the width of the ball."""

import json

import numpy as np
import pytest

from tests.support.bouncing_balls import cut_disc, hertz_motion
from tests.support.drawn_falls import HEIGHT, WIDTH, ellipse, texture
from tests.support.films import ffmpeg

pytest.importorskip("cv2")

from neuma_lib.capture.clip import analyse_clip  # noqa: E402
from neuma_lib.cli import main  # noqa: E402
from neuma_lib.io.mesh import read_mesh  # noqa: E402
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
    return film(path, [ellipse(motion(k / RATE), RADIUS, RADIUS) for k in range(count)], RATE, shake)


def film(path, silhouettes, rate, shake=0):
    rng = np.random.default_rng(0)
    empty, pictures = texture(), []
    for k, silhouette in enumerate(silhouettes):
        seen = np.where(silhouette[..., None], (225, 70, 40), empty)
        seen = np.roll(seen, round(shake * np.sin(k)), axis=1) + rng.normal(0, 2, empty.shape)
        pictures.append(np.clip(seen, 0, 255).astype(np.uint8))
    options = ("-f", "rawvideo", "-pix_fmt", "rgb24", "-s", f"{WIDTH}x{HEIGHT}", "-r", rate, "-i", "-")
    ffmpeg(*options, "-c:v", "libx264", "-crf", 10, path, content=np.stack(pictures).tobytes())
    return path


@pytest.fixture(scope="module")
def video(tmp_path_factory):
    return write(tmp_path_factory.mktemp("clip") / "ball.mp4", 46)


def test_gravity_width_and_rebound_are_those_that_were_drawn(video, tmp_path, capsys):
    assert main(["clip", str(video), str(tmp_path / "ball"), "--diameter", str(DIAMETER)]) == 0
    report = json.loads((tmp_path / "ball/clip.json").read_text())
    fall, rise = report["flights"]
    assert report["shape"]["ball"]
    contact = report["rebounds"][0]["ball"][
        "contact_s_band"
    ]  # none was drawn, and no frame can show more than one
    assert contact[0] is contact[1] is None and contact[2] < 1 / RATE
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


def test_a_soft_ball_at_240_frames_a_second_shows_its_stiffness(tmp_path, capsys):
    """Half a pixel of the floor is 0.5 / (I d) = 0.5 / 6 of the duration, and 2.5 times as much of the stiffness."""
    radius, scale, fall, stiffness = 0.026, 0.001, 0.1, 1000.0  # 1.4 m/s, flattened by 0.16 of the radius
    times = np.arange(66) / 240
    y, _ = hertz_motion(times, radius, fall, stiffness)
    places = [(110 + 400 * t, 199.3 - h / scale) for t, h in zip(times, y)]
    video = film(
        tmp_path / "soft.mp4", [cut_disc(p, radius / scale, 199.3, (HEIGHT, WIDTH)) for p in places], 240
    )
    assert main(["clip", str(video), str(tmp_path / "soft"), "--diameter", str(2 * radius)]) == 0
    report = json.loads((tmp_path / "soft/clip.json").read_text())
    low, middle, high = report["rebounds"][0]["ball"]["modulus_per_density_m2_s2_band"]
    assert low < stiffness < high and middle == pytest.approx(stiffness, rel=2.5 * 0.5 / 6)
    mesh = read_mesh(tmp_path / "soft/shape.ply")
    assert mesh.volume == pytest.approx(4 / 3 * np.pi * radius**3, rel=0.1)
    page = (tmp_path / "soft/clip.md").read_text()
    for file in ("shape.png", "rebound_1.png"):
        assert (tmp_path / "soft" / file).is_file() and f"({file})" in page
    assert "duration of contact before" in capsys.readouterr().out
