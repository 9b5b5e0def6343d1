"""What several tests share of capture agreement."""

import numpy as np

from tests.support.board_pictures import looking_at

WIDTH, HEIGHT, FOCAL = 320, 240, 300.0
K = np.array([[FOCAL, 0, WIDTH / 2], [0, FOCAL, HEIGHT / 2], [0, 0, 1]])
RADII = np.array([0.12, 0.08, 0.06])


def looking(eye):
    return looking_at(np.array(eye, float), (0.1, 0.1, 0.0), up=(0.0, 1.0, 0.0))


def ellipsoid_mask(view, centre=(0.1, 0.1, 0.0), radii=RADII):
    """Exact: a pixel is inside where its ray meets the ellipsoid."""
    y, x = np.mgrid[:HEIGHT, :WIDTH] + 0.5
    rays = np.stack([(x - K[0, 2]) / FOCAL, (y - K[1, 2]) / FOCAL, np.ones_like(x)], axis=-1) @ view[:3, :3]
    eye = (-view[:3, :3].T @ view[:3, 3] - centre) / radii
    d = rays / radii
    b, c = d @ eye, eye @ eye - 1
    return b * b - c * (d * d).sum(axis=-1) >= 0


def ring(count):
    angles = 2 * np.pi * np.arange(count) / count
    return np.stack([looking((np.cos(a), 0.4 + 0.3 * (i % 2), np.sin(a))) for i, a in enumerate(angles)])
