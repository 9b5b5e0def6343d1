"""Pictures of a printed board through a known camera, drawn by following each pixel's rays to the paper."""

import numpy as np

from neuma_lib.capture import board as boards
from neuma_lib.capture.lens import Lens
from neuma_lib.config.capture import BoardConfig

BOARD = BoardConfig(square=0.03)
LENS = Lens(
    800,
    600,
    np.array([[700.0, 0, 411.3], [0, 702.0, 291.7], [0, 0, 1]]),
    np.array([-0.12, 0.05, 1e-3, -7e-4, 0.0]),
)


def looking_at(centre, target, up=(0.0, 0.0, 1.0)):
    """World to camera (4, 4) of a camera at ``centre`` that looks at ``target``; x right, y down, z forward."""
    forward = np.subtract(target, centre)
    forward = forward / np.linalg.norm(forward)
    right = np.cross(forward, up)
    right /= np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3, :3] = np.stack([right, np.cross(forward, right), forward])
    pose[:3, 3] = -pose[:3, :3] @ centre
    return pose


def around(count, radius=0.55, height=0.4, board=BOARD):
    """Poses (count, 4, 4) around the board's middle, in its frame."""
    middle = np.array([*np.multiply(board.squares, board.square / 2), 0.0])
    angles = np.linspace(0, 2 * np.pi, count, endpoint=False) + 0.3
    return np.stack(
        [looking_at(middle + [radius * np.cos(a), radius * np.sin(a), height], middle) for a in angles]
    )


def picture(pose, lens=LENS, board=BOARD, samples=4):
    """Grey picture (H, W), uint8, of the board on a grey floor; ``samples`` each way in a pixel."""
    cells = np.array(board.squares)
    texture = print_texture(board)
    density = texture.shape[1] / (cells[0] * board.square)
    total = np.zeros((lens.height, lens.width))
    steps = (np.arange(samples) + 0.5) / samples
    x, y = np.meshgrid(np.arange(lens.width), np.arange(lens.height))
    for dx in steps:
        for dy in steps:
            rays = lens.directions(np.stack([x.ravel() + dx, y.ravel() + dy], axis=1))
            rays = np.concatenate([rays, np.ones((len(rays), 1))], axis=1) @ pose[:3, :3]
            centre = -pose[:3, :3].T @ pose[:3, 3]
            hit = centre[:2] - rays[:, :2] * (centre[2] / rays[:, 2])[:, None]
            column = np.floor(hit[:, 0] * density).astype(int)
            row = np.floor(texture.shape[0] - hit[:, 1] * density).astype(int)
            on = (column >= 0) & (column < texture.shape[1]) & (row >= 0) & (row < texture.shape[0])
            on &= rays[:, 2] < 0
            values = np.full(len(hit), 170.0)
            values[on] = 30 + 0.8 * texture[row[on], column[on]]
            total += values.reshape(total.shape)
    return np.round(total / samples**2).astype(np.uint8)


def print_texture(board=BOARD, pixels=224):
    """The print (rows pixels, columns pixels), uint8, from the rectangles that the page draws."""
    columns, rows = board.squares
    texture = np.full((rows * pixels, columns * pixels), 255, np.uint8)
    for rectangles, value in zip(boards.black_rectangles(board), (0, 255)):
        for x, y, w, h in rectangles / board.square * pixels:
            texture[round(rows * pixels - y - h) : round(rows * pixels - y), round(x) : round(x + w)] = value
    return texture
