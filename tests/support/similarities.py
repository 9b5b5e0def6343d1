"""Random similarities, and exact detections of the board."""

import numpy as np

from neuma_lib.capture.calibration import board as boards
from neuma_lib.capture.calibration import placement
from tests.support.board_pictures import BOARD, LENS


def random_similarity(rng):
    rotation = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    return placement.Similarity(
        rng.uniform(0.2, 5), rotation * np.sign(np.linalg.det(rotation)), rng.normal(size=3)
    )


def exact(poses, lens=LENS):
    """The corners that each camera must detect."""
    points = boards.corner_positions(BOARD)
    detections = []
    for pose in poses:
        pixels = lens.project(points @ pose[:3, :3].T + pose[:3, 3])
        inside = ((pixels > 0) & (pixels < [lens.width, lens.height])).all(axis=1)
        detections.append(boards.Detection(np.flatnonzero(inside), pixels[inside]))
    return detections
