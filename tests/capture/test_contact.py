"""When and where silhouettes reach the floor: a ball that falls, seen from above."""

import numpy as np
import pytest

from neuma_lib.capture.motion.contact import contact_time, lowest_points
from neuma_lib.capture.motion.flight import Filmed, find_flight
from tests.support.board_pictures import looking_at

K = np.array([[400.0, 0, 160], [0, 400, 120], [0, 0, 1]])
RADIUS = 0.06


def ball(view, centre):
    """Pixels whose rays pass the ball's centre by less than its radius, (240, 320)."""
    rows, columns = np.mgrid[:240, :320]
    rays = np.stack([columns + 0.5, rows + 0.5, np.ones(rows.shape)], axis=-1) @ np.linalg.inv(K).T
    rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
    seen = view[:3, :3] @ centre + view[:3, 3]
    return np.linalg.norm(np.cross(rays, seen), axis=-1) < RADIUS


@pytest.mark.parametrize("height", [0.3, 0.6, 0.9])
def test_the_lowest_point_of_a_ball_is_found_and_never_too_high(height):
    eye = np.array([0.4, height, 1.2])
    view = looking_at(eye, (0.0, 0.15, 0.0), up=(0.0, 1.0, 0.0))
    centres = np.stack([np.full(9, 0.02), np.linspace(0.3, 0.03, 9), np.full(9, -0.03)], axis=1)
    heights = lowest_points([ball(view, c) for c in centres], centres, view, K)
    off = heights - (centres[:, 1] - RADIUS)
    pixel = 1.3 / 400
    # Seen along a slope, the outline's lowest point is that of a ball which the slope makes longer.
    steepest = np.hypot(1.0, (height - centres[:, 1]) / 1.2)
    assert (off < pixel).all() and (off > -1.4 * RADIUS * (steepest - 1) - 1.5 * pixel).all()


def test_contact_is_the_mean_of_the_cameras():
    times = [np.arange(5) / 100, np.arange(5) / 100 + 0.002, np.arange(5) / 100 + 0.004]
    falling = np.array([0.1, 0.05, 0.01, -0.01, -0.02])
    shadow = np.array([0.1, -0.05, -0.06, -0.07, -0.08])
    assert contact_time(times, [falling, falling, shadow]) == pytest.approx(0.03)
    assert contact_time(times, [falling + 0.1] * 3) == np.inf
    assert contact_time(times[:2], [falling, falling]) == pytest.approx(0.031)


def filmed(frames, times, masks, view, flown):
    pixels = np.zeros((len(masks), 240, 320, 3), np.uint8)
    return Filmed("one", frames, times, pixels, np.stack(masks), (0, flown - 1), view, K, 240)


@pytest.mark.parametrize("seed", range(4))
def test_the_place_of_contact_gives_one_camera_its_distance(seed):
    """A ball that jumps, in a room whose unit is not a metre: its gravity states the unit."""
    pytest.importorskip("cv2")
    rng = np.random.default_rng(seed)
    unit, eye = rng.uniform(0.5, 3.0), np.array([rng.uniform(-0.5, 0.5), rng.uniform(0.4, 0.9), 1.2])
    view = looking_at(eye, (0.0, 0.15, 0.0), up=(0.0, 1.0, 0.0))
    start = np.array([rng.uniform(-0.1, 0.1), rng.uniform(0.35, 0.45), rng.uniform(-0.2, 0.1)])
    v0 = np.array([rng.uniform(-0.3, 0.3), -0.3, rng.uniform(-0.2, 0.2)])
    landing = float(np.roots([-9.81 / 2, v0[1], start[1] - RADIUS]).max())
    times = np.arange(int(120 * landing) + 12) / 120
    fallen, risen = np.minimum(times, landing), np.maximum(times - landing, 0)
    centres = start + v0 * times[:, None]
    centres[:, 1] = start[1] + v0[1] * fallen - 9.81 / 2 * fallen**2
    centres[:, 1] += (9.81 * landing - v0[1]) / 2 * risen - 9.81 / 2 * risen**2
    masks, flown = [ball(view, centre) for centre in centres], int((times < landing).sum())
    scaled = view.copy()
    scaled[:3, 3] *= unit
    one = filmed(np.arange(len(times)), times, masks, scaled, flown)
    gravity = find_flight([one], "take", metric=False).fall.gravity
    (ratio, deviation), (angle, _) = gravity.ratio, gravity.angle()
    assert gravity.measured and "plane of contact" in gravity.source
    assert abs(ratio / unit - 1) < 2 * deviation / unit and 0.005 < deviation / unit < 0.12
    assert angle < 5
    left = filmed(np.arange(flown), times[:flown], masks[:flown], scaled, flown)
    assert not find_flight([left], "take", metric=False).fall.gravity.measured
    print(f"unit {ratio / unit - 1:+.3f} +- {deviation / unit:.3f}, {angle:.1f} degrees")
