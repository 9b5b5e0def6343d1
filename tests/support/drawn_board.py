"""Ellipsoids over a printed board, drawn by ray casting for photographs and videos of captures."""

from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from tests.support.board_pictures import LENS, picture
from tests.support.films import ffmpeg


class Solid(NamedTuple):
    """An ellipsoid in the frame of the board."""

    centre: np.ndarray
    turn: Rotation
    radii: np.ndarray
    colour: tuple[int, int, int] = (205, 95, 50)


class Eye:
    """A camera of the drawn room: its empty picture, and ellipsoids before it."""

    def __init__(self, pose):
        self.pose, self.empty = pose, np.repeat(picture(pose, samples=2)[..., None], 3, axis=2)
        x, y = np.meshgrid(np.arange(LENS.width) + 0.5, np.arange(LENS.height) + 0.5)
        rays = LENS.directions(np.stack([x.ravel(), y.ravel()], axis=1))
        self.rays = np.concatenate([rays, np.ones((len(rays), 1))], axis=1) @ pose[:3, :3]
        self.at = -pose[:3, :3].T @ pose[:3, 3]

    def see(self, *solids):
        """Picture (H, W, 3), and number of the nearest solid in each pixel (H, W), from 1."""
        seen, numbers = self.empty.copy().reshape(-1, 3), np.zeros(len(self.rays), np.uint8)
        nearest = np.full(len(self.rays), np.inf)
        for k, (centre, turn, radii, colour) in enumerate(solids, 1):
            eye, rays = turn.inv().apply(self.at - centre) / radii, turn.inv().apply(self.rays) / radii
            a, b, c = (rays**2).sum(axis=1), rays @ eye, eye @ eye - 1
            root = b * b - a * c
            depth = np.where(root > 0, (-b - np.sqrt(np.maximum(root, 0))) / a, np.inf)
            hit = depth < nearest
            nearest[hit], numbers[hit] = depth[hit], k
            body = eye + depth[hit][:, None] * rays[hit]
            grain = np.sin(9 * body[:, 0] + 1) * np.sin(11 * body[:, 1]) * np.sin(10 * body[:, 2] + 2)
            seen[hit] = np.clip(colour * (1 + 0.35 * grain[:, None]), 0, 255)
        return seen.reshape(self.empty.shape), numbers.reshape(self.empty.shape[:2])


def write_video(path, pictures, rate=120):
    height, width = pictures[0].shape[:2]
    raw = ("-f", "rawvideo", "-pix_fmt", "rgb24", "-s", f"{width}x{height}", "-r", rate, "-i", "-")
    ffmpeg(*raw, "-c:v", "libx264", "-crf", 10, path, content=np.stack(pictures).tobytes())
