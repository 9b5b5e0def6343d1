"""Draw reconstructed cameras and points, and the floor in the photographs."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image, ImageDraw

from neuma_lib.capture.calibration.placement import camera_centres, upright
from neuma_lib.capture.calibration.poses import Poses
from neuma_lib.capture.calibration.room import BOX_MIDDLE, Room
from neuma_lib.capture.pictures import group_of, picture_sheet, read_picture
from neuma_lib.capture.tools import new_figure, save_figure
from neuma_lib.fitting.frame_batches import spread_frames
from neuma_lib.io.images import OPENGL_TO_OPENCV, read_transforms
from neuma_lib.project.capture_folder import PHOTOGRAPHS

_GRID = 0.1  # spacing of the floor lines [m of the room]
_QUANTILES = (0.02, 0.98)  # quantiles of the points that limit a plot of cameras and points
_MAX_PHOTOGRAPHS = 8  # photographs into which the floor is drawn


def draw_room(path: str | Path, room: Room) -> None:
    """Plot a room's cameras and points, from above and from the side, in metres."""
    suffix = f", board {1000 * room.board.residual:.2f} mm" if room.board else ""
    draw_cameras(path, room.poses, "m", suffix, floor=True)


def draw_poses(path: str | Path, poses: Poses) -> None:
    """Plot cameras and points in a world without metric scale and floor. The mean up axis of the cameras is up."""
    up = -poses.viewmats[:, 1, :3].mean(axis=0)
    size = np.linalg.norm(up)
    middle = np.median(poses.points if len(poses.points) else camera_centres(poses.viewmats), axis=0)
    level = upright(up / size if size > 1e-6 else np.array([0.0, 1.0, 0.0]), middle)
    draw_cameras(path, poses.moved(level), "not yet metres")


def draw_cameras(path: str | Path, poses: Poses, unit: str, suffix: str = "", floor: bool = False) -> None:
    """Plot cameras and points from above and from the side, y up, the scene around the origin, floor at y = 0."""
    centres = camera_centres(poses.viewmats)
    forward = poses.viewmats[:, 2, :3]
    fixed = np.array([group_of(name) != PHOTOGRAPHS for name in poses.names])
    reach = 1.2 * max(np.abs(centres).max(), 0.1)
    near = (np.abs(poses.points) < reach).all(axis=1)
    extent = centres
    if near.any():
        extent = np.concatenate([centres, np.quantile(poses.points[near], _QUANTILES, axis=0)])
    low, high = extent.min(axis=0) - 0.1 * reach, extent.max(axis=0) + 0.1 * reach
    figure = new_figure(12, 6)
    groups = ((~fixed, "tab:blue", "photographs"), (fixed, "tab:red", "fixed cameras"))
    arrows = {"angles": "xy", "scale_units": "xy", "scale": 1, "width": 0.004}
    sides = ((0, 2, "from above"), (0, 1, "from the side"))
    for axes, (across, up, title) in zip(figure.subplots(1, 2), sides):
        axes.scatter(*poses.points[near][:, [across, up]].T, s=1, c=poses.colours[near] / 255.0, linewidths=0)
        for chosen, colour, label in groups:
            starts = centres[chosen][:, [across, up]].T
            ends = (0.15 * reach * forward[chosen][:, [across, up]]).T
            axes.quiver(*starts, *ends, color=colour, label=label, **arrows)
        axes.set(title=title, xlabel=f"x [{unit}]", ylabel=f"{'xyz'[up]} [{unit}]", aspect="equal")
        # From above, x points right and z towards the viewer.
        limits = (low[1], high[1]) if up == 1 else (high[2], low[2])
        axes.set(xlim=(low[0], high[0]), ylim=limits)
        axes.grid(alpha=0.3)
        if up == 2:
            axes.legend()
        elif floor:
            axes.axhline(0, color="black", linewidth=1)
    title = f"{len(poses.names)} of {len(poses.names) + len(poses.lost)} pictures"
    title += f", {poses.error:.2f} px" if np.isfinite(poses.error) else ""
    figure.suptitle(title + suffix)
    save_figure(path, figure)


def draw_floor(path: str | Path, transforms: str | Path) -> None:
    """Draw floor lines and the simulation box into the pictures of a transforms.json.

    This shows the floor, vertical direction and scale that later stages use.
    """
    data = read_transforms(transforms)
    scale = data.get("world", {}).get("scale", 1.0)
    photographs = [frame for frame in data["frames"] if frame["group"] == PHOTOGRAPHS]
    frames = [frame for frame in data["frames"] if frame["group"] != PHOTOGRAPHS]
    frames += [photographs[i] for i in spread_frames(len(photographs), _MAX_PHOTOGRAPHS)]
    pictures = []
    for frame in frames:
        picture = Image.fromarray(read_picture(Path(transforms).parent / frame["file_path"]))
        viewmat = np.linalg.inv(np.array(frame["transform_matrix"]) @ OPENGL_TO_OPENCV)
        draw = ImageDraw.Draw(picture)
        wide = max(1, picture.width // 400)
        for ends, colour, lines in _box_lines(_GRID * scale):
            _draw_line(draw, ends, viewmat, frame, colour, lines * wide)
        pictures.append((frame["file_path"], np.asarray(picture)))
    title = f"floor lines every {_GRID:g} m, x red, y (up) green, z blue, the box is {1 / scale:g} m wide"
    picture_sheet(path, pictures, title, columns=3)


def _box_lines(spacing: float) -> list[tuple[np.ndarray, str, int]]:
    """Ends (2, 3), colour and width of floor lines, edges of the box [0, 1]^3, and axes from BOX_MIDDLE."""
    lines = []
    count = int(0.5 / spacing)
    for k in range(-count, count + 1):
        at = 0.5 + k * spacing
        lines += [
            (np.array([[at, 0, 0], [at, 0, 1]]), "white", 1),
            (np.array([[0, 0, at], [1, 0, at]]), "white", 1),
        ]
    for axis in range(3):
        for a, b in ((0, 0), (0, 1), (1, 0), (1, 1)):
            start = np.insert(np.array([a, b], np.float64), axis, 0.0)
            lines.append((np.stack([start, start + np.eye(3)[axis]]), "yellow", 1))
    middle = np.array(BOX_MIDDLE)
    for axis, colour in enumerate(("red", "lime", "blue")):
        lines.append((np.stack([middle, middle + 1.5 * spacing * np.eye(3)[axis]]), colour, 3))
    return lines


def _draw_line(
    draw: ImageDraw.ImageDraw,
    ends: np.ndarray,
    viewmat: np.ndarray,
    frame: Mapping[str, Any],
    colour: str,
    width: int,
) -> None:
    """Draw a line in space, clipped at the camera plane."""
    a, b = ends @ viewmat[:3, :3].T + viewmat[:3, 3]
    nearest = 1e-3
    if max(a[2], b[2]) <= nearest:
        return
    if a[2] < nearest:
        a = b + (a - b) * (b[2] - nearest) / (b[2] - a[2])
    if b[2] < nearest:
        b = a + (b - a) * (a[2] - nearest) / (a[2] - b[2])
    # Pillow's pixel centres lie at integers.
    pixels = [
        (frame["fl_x"] * x / z + frame["cx"] - 0.5, frame["fl_y"] * y / z + frame["cy"] - 0.5)
        for x, y, z in (a, b)
    ]
    draw.line(pixels, fill=colour, width=width)
