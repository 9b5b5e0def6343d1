"""Pictures of a printed board, alone or in a room, through a known camera, by ray casting."""

from functools import cache

import numpy as np
from scipy.ndimage import map_coordinates

from neuma_lib.capture.calibration import board as boards
from neuma_lib.capture.calibration.lens import Lens
from neuma_lib.config.capture import BoardConfig

BOARD = BoardConfig(square=0.03)
LENS = Lens(
    800,
    600,
    np.array([[700.0, 0, 411.3], [0, 702.0, 291.7], [0, 0, 1]]),
    np.array([-0.12, 0.05, 1e-3, -7e-4, 0.0]),
)


def looking_at(centre, target, up=(0.0, 0.0, 1.0)):
    """World to camera (4, 4) of a camera at ``centre`` aimed at ``target``; x right, y down, z forward."""
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


ROOM_LENSES = {
    "photographs": Lens(
        800,
        600,
        np.array([[690.0, 0, 404.0], [0, 691.0, 297.5], [0, 0, 1]]),
        np.array([-0.10, 0.04, 3e-4, -2e-4, 0.0]),
    ),
    "fixed": Lens(
        640,
        480,
        np.array([[560.0, 0, 321.5], [0, 560.0, 238.0], [0, 0, 1]]),
        np.array([-0.05, 0.01, 0, 0, 0.0]),
    ),
}
"""Of a phone and of fixed cameras; neither is centred, and a phone's pixels are not quite square."""
BOXES = (
    ((0.24, 0.05, 0.0), (0.34, 0.17, 0.09)),
    ((-0.12, 0.10, 0.0), (-0.04, 0.20, 0.14)),
    ((0.05, 0.32, 0.0), (0.20, 0.40, 0.06)),
)
"""Minimum and maximum corners of boxes next to the board, in its frame [m]."""


def room_cameras():
    """Name, pose and name of the lens of 24 photographs in two rings around the board, and of two stills."""
    rng = np.random.default_rng(11)
    middle = np.array([0.09, 0.15, 0.02])
    cameras = []
    for ring, (height, radius) in enumerate(((0.36, 0.62), (0.62, 0.42))):
        for k in range(12):
            angle = 2 * np.pi * (k + 0.5 * ring) / 12 + rng.normal(0, 0.05)
            centre = middle + [radius * np.cos(angle), radius * np.sin(angle), height]
            centre = centre + rng.normal(0, 0.03, 3)
            pose = looking_at(centre, middle + rng.normal(0, 0.03, 3))
            if k % 4 == 3:  # the phone was turned
                pose[:3] = np.array([[0.0, 1, 0], [-1, 0, 0], [0, 0, 1]]) @ pose[:3]
            cameras.append((f"photographs/{ring}{k:02}.jpg", pose, "photographs"))
    for name, centre in (("left", (-0.55, -0.35, 0.45)), ("right", (0.75, -0.30, 0.5))):
        cameras.append((f"{name}/{name}.jpg", looking_at(np.array(centre), middle), "fixed"))
    return cameras


def room_picture(pose, lens_name, samples=2):
    """Noisy RGB picture (H, W, 3), uint8, of the board on a spotted floor among boxes; the exposure changes with the
    place of the camera."""
    centre = -pose[:3, :3].T @ pose[:3, 3]
    lens = ROOM_LENSES[lens_name]
    total = np.zeros((lens.height * lens.width, 3))
    steps = (np.arange(samples) + 0.5) / samples
    for dx in steps:
        for dy in steps:
            total += _room_colours(centre, _directions(lens_name, dx, dy) @ pose[:3, :3])
    rng = np.random.default_rng(abs(int(1e6 * centre.sum())))
    exposure = 0.9 + 0.2 * (centre[0] - np.floor(centre[0]))
    noisy = exposure * total / samples**2 + rng.normal(0, 2.0, total.shape)
    return np.clip(np.round(noisy), 0, 255).astype(np.uint8).reshape(lens.height, lens.width, 3)


def _room_colours(centre, rays):
    """Colours (N, 3) that rays (N, 3) from a point meet."""
    with np.errstate(divide="ignore", invalid="ignore"):
        nearest = np.where(rays[:, 2] < 0, -centre[2] / rays[:, 2], np.inf)
        floor = nearest.copy()
        shade = np.ones(len(rays))
        for low, high in BOXES:
            near, far = (np.subtract(low, centre) / rays, np.subtract(high, centre) / rays)
            enter, leave = np.minimum(near, far), np.maximum(near, far).min(axis=1)
            face, enter = enter.argmax(axis=1), enter.max(axis=1)
            hit = (enter < leave) & (enter > 0) & (enter < nearest)
            nearest = np.where(hit, enter, nearest)
            shade = np.where(hit, np.array([0.7, 0.85, 1.0])[face], shade)
    seen = np.isfinite(nearest) & (nearest < 5)
    points = centre + np.where(seen, nearest, 0.0)[:, None] * rays
    colours = np.full((len(rays), 3), 200.0)
    colours[seen] = _spots(points[seen]) * shade[seen][:, None]
    texture = print_texture()
    density = texture.shape[1] / (BOARD.squares[0] * BOARD.square)
    column = np.floor(points[:, 0] * density).astype(int)
    row = np.floor(texture.shape[0] - points[:, 1] * density).astype(int)
    on = seen & (nearest == floor) & (column >= 0) & (column < texture.shape[1])
    on &= (row >= 0) & (row < texture.shape[0])
    colours[on] = (20 + 0.85 * texture[row[on], column[on]])[:, None]
    return colours


def _spots(points):
    """Colours (N, 3) of points in space, a brown with three sizes of spots."""
    rng = np.random.default_rng(7)
    light = np.full(len(points), 120.0)
    for size, strength in ((0.005, 45.0), (0.015, 55.0), (0.05, 45.0)):
        lattice = rng.uniform(-1, 1, (48, 48, 48))
        light += strength * map_coordinates(lattice, points.T / size, order=1, mode="grid-wrap")
    return np.clip(light, 5, 250)[:, None] * [1.0, 0.85, 0.7]


@cache
def _directions(lens_name, dx, dy):
    """Directions (H W, 3) in the camera's frame of points of all pixels."""
    lens = ROOM_LENSES[lens_name]
    x, y = np.meshgrid(np.arange(lens.width), np.arange(lens.height))
    flat = lens.directions(np.stack([x.ravel() + dx, y.ravel() + dy], axis=1))
    return np.concatenate([flat, np.ones((len(flat), 1))], axis=1)
