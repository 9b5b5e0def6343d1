"""What makes a room ordinary: furniture, a ruler instead of the board, a second object in motion, and marks by hand."""

from typing import Any

import numpy as np
import trimesh

from neuma_lib.data.blender.appearance import parse_color
from studies.capture_benchmark.pictures import TONES, dead_leaves
from studies.capture_benchmark.room import Moving
from studies.capture_benchmark.settings import DemoCapturesConfig, DemoObjectConfig, DemoRoomConfig
from studies.capture_benchmark.stage import MIDDLE, lying, photographers, solid

RULER = (0.40, 0.03, 0.001)
"""Length, width, and side of a pixel of the ruler that lies in place of the board [m]."""
NEAR, FREE = (0.52, 0.8), 0.3
"""Distances of low pieces from the middle, and from the middles of object and board [m]."""
TEXEL = 0.002  # side of a pixel of furniture [m]
BORDER = 12  # distance of marks from the border of a photograph [px]


def furniture(
    room: DemoRoomConfig, item: DemoObjectConfig
) -> list[tuple[list[np.ndarray], list[np.ndarray]]]:
    """Corners (4, 3) [m] from the middle of the floor, and textures (H, W, 3) of the visible sides of each piece.

    Every other piece is low and near the object, the others stand along the walls. The first one has the colour of the
    object.
    """
    rng, pieces = np.random.default_rng([room.seed, item.difficulties.seed]), []
    keep = np.array([item.place, (room.page[0], room.page[2])])
    body = parse_color(item.appearance.colors["body"]) * 255
    for number in range(item.difficulties.furniture):
        if number % 2 == 0:
            half = rng.uniform((0.05, 0.015, 0.04), (0.13, 0.07, 0.10))
            while True:
                away, angle = rng.uniform(*NEAR), rng.uniform(0, 2 * np.pi)
                place = away * np.array([np.cos(angle), np.sin(angle)])
                if np.linalg.norm(place - keep, axis=1).min() > FREE:
                    break
            turn = rng.uniform(0, 2 * np.pi)
        else:
            half = rng.uniform((0.12, 0.2, 0.1), (0.35, 0.6, 0.2))
            along, wall = rng.uniform(-0.8, 0.8) * room.half, rng.integers(4)
            turn = np.pi / 2 * wall
            place = (room.half - half[2] - 0.02) * np.array([np.sin(turn), np.cos(turn)])
            place += along * np.array([np.cos(turn), -np.sin(turn)])
        tint = body / TONES.mean() if number == 0 else rng.uniform(0.3, 1.4, 3)
        tones = np.clip(TONES * tint, 8, 240)
        pieces.append(_piece(place, half, turn, tones, room.seed + 100 + 7 * number))
    return pieces


def _piece(
    place: np.ndarray, half: np.ndarray, turn: float, tones: np.ndarray, seed: int
) -> tuple[list[np.ndarray], list[np.ndarray]]:
    """A box with half sides (3,) on the floor at (x, z), without its lower side."""
    c, s = np.cos(turn), np.sin(turn)
    x, y, z = np.array([c, 0, -s]), np.array([0.0, 1.0, 0.0]), np.array([s, 0, c])
    middle = np.array([place[0], half[1], place[1]])
    corners, pictures = [], []
    for k, (normal, right, up) in enumerate(
        ((half[2] * z, half[0] * x, half[1] * y), (-half[2] * z, -half[0] * x, half[1] * y),
         (half[0] * x, -half[2] * z, half[1] * y), (-half[0] * x, half[2] * z, half[1] * y),
         (half[1] * y, half[0] * x, -half[2] * z))
    ):  # fmt: skip
        front = middle + normal
        corners.append(
            np.stack([front - right + up, front + right + up, front + right - up, front - right - up])
        )
        width, height = 2 * np.linalg.norm(right), 2 * np.linalg.norm(up)
        pictures.append(dead_leaves(width, height, TEXEL, seed + k, tones))
    return corners, pictures


def rolling_ball(times: np.ndarray) -> Moving:
    """A ball that rolls across the background at times (T,) [s]."""
    radius, speed = 0.07, 0.7
    ball = trimesh.creation.icosphere(subdivisions=3, radius=radius)
    start, way = MIDDLE + [0.2, radius, -1.0], np.array([1.0, 0.0, 0.3]) / np.hypot(1.0, 0.3)
    axis = np.cross([0.0, 1.0, 0.0], way)
    vertices, velocities = [], []
    for time in times:
        turned = trimesh.transformations.rotation_matrix(speed * time / radius, axis)[:3, :3]
        around = ball.vertices @ turned.T
        vertices.append(start + speed * time * way + around)
        velocities.append(speed * way + np.cross(speed / radius * axis, around))
    stripes = (np.floor(6 * ball.vertices[:, :1] / radius).astype(int) % 2).repeat(3, axis=1)
    colors = np.where(stripes, (0.85, 0.15, 0.1), (0.9, 0.85, 0.8))
    return Moving(
        np.stack(vertices).astype(np.float32),
        np.stack(velocities).astype(np.float32),
        np.asarray(ball.faces),
        colors,
    )


def marks(demo: DemoCapturesConfig, name: str, files: list[str]) -> dict[str, Any]:
    """Entries of capture.yaml that a user marks in photographs: the box of the object, and the ends of the ruler.

    The box is in the photograph that shows the object completely and largest, the ends in the first two from different
    sides. Each mark has an error of a hand.
    """
    item, eyes = demo.objects[name], photographers(demo, name)
    rng = np.random.default_rng([demo.seed, 4, *name.encode()])
    error, entries = item.difficulties.marked, {}
    if item.difficulties.furniture:
        mesh = solid(item)
        vertices = lying(item, mesh).apply(mesh.vertices)
        boxes = {}
        for file, eye in zip(files, eyes):
            pixels = eye.project(vertices)
            box = np.concatenate([pixels.min(axis=0), pixels.max(axis=0)])
            if _within(eye, pixels):
                boxes[file] = box
        largest = max(boxes, key=lambda file: float(np.prod(boxes[file][2:] - boxes[file][:2])))
        outwards = np.array([-1, -1, 1, 1]) * (1 + np.abs(rng.normal(0, error, 4)))
        entries["object"] = {largest: [round(float(v), 1) for v in boxes[largest] + outwards]}
    if not item.difficulties.board:
        half = RULER[0] / 2
        ends = MIDDLE + demo.room.page + np.array([[-half, 0.0, 0.0], [half, 0.0, 0.0]])
        chosen: dict[str, Any] = {}
        for file, eye in zip(files, eyes):
            views = [eye.c2w[:3, 3] - ends.mean(axis=0)] + [view for _, view in chosen.values()]
            cosines = [
                np.dot(views[0], view) / np.linalg.norm(views[0]) / np.linalg.norm(view) for view in views[1:]
            ]
            if len(chosen) < 2 and _within(eye, eye.project(ends)) and max(cosines, default=0.0) < 0.9:
                chosen[file] = eye.project(ends) + rng.normal(0, error, (2, 2)), views[0]
        entries["length"] = {
            "metres": RULER[0],
            "ends": {file: np.round(pixels, 1).tolist() for file, (pixels, _) in chosen.items()},
        }
    return entries


def _within(eye, pixels: np.ndarray) -> bool:
    size = np.array([eye.lens.width, eye.lens.height])
    return bool(((pixels > BORDER) & (pixels < size - BORDER)).all())
