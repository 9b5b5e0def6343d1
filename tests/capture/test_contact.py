"""Where silhouettes reach the floor: a ball that falls, seen from above."""

import numpy as np
import pytest

from neuma_lib.capture.motion.contact import contact_time, lowest_points
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
