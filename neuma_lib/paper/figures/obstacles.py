"""True motions of scenes with obstacles, without training: a soft ball rolls down a stair, a press flattens a ball of
clay, and sand runs through an hourglass, which is drawn as glass. Not in the paper.
"""

import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from PIL import Image

from neuma_lib.config.blender import AppearanceConfig
from neuma_lib.data.blender.bodies import make_body
from neuma_lib.data.blender.scene import render_images
from neuma_lib.evaluation.plotting import rendering, style
from neuma_lib.geometry.obstacles import Obstacle, obstacles
from neuma_lib.geometry.shapes import place
from neuma_lib.io.files import parse_json
from neuma_lib.io.hdf5 import read_arrays
from neuma_lib.io.simulator import simulator
from neuma_lib.paper.image_grid import ImageGrid, rows_figure
from neuma_lib.splatting.viewpoints import framing

LEFT, TOP = 0.75, 0.05
DIRECTION = np.array([0.35, 0.36, 1.0])
"""From the scene to the camera: so far above the floor that no horizon is in the frame."""
FLOOR, FLOOR_REACH = (0.93, 0.93, 0.91), 40.0
"""Colour of the floor, and half of its side [m], so that it fills the frame."""
GLASS = 0.08  # opacity of an obstacle around a body


def data(inputs, params, log) -> ImageGrid:
    """A row of pictures for each scene, from its first to its last frame."""
    rows, times = [], {}
    for file, (title, scene) in zip(inputs.truth, params.scenes.items(), strict=True):
        arrays, attributes = read_arrays(file, required=("x", "tracers", "frames"))
        picked = rendering.evenly(params.shown, len(arrays["frames"]))
        seconds = arrays["frames"][picked] * attributes["dt"]
        mesh = place(
            scene["shape"], scene["size"], scene["height"], scene["center"], rotation=scene["rotation"]
        )
        look = AppearanceConfig(**scene["appearance"])
        body = make_body(mesh, look, arrays["x"][picked], arrays["tracers"][picked])
        model = simulator(parse_json(attributes["simulation"], file))
        around = [_shown(each, mesh.centroid) for each in obstacles(model.colliders, seconds)]
        rows.append(_pictures(body, around, params))
        times[title] = [f"{1e3 * t:.0f} ms" for t in seconds]
        log(f"{title}: {arrays['x'].shape[1]} particles, {', '.join(times[title])}")
    return ImageGrid(np.stack(rows), tuple(times), ("",) * params.shown, {"times": list(times.values())})


@style.styled
def draw(grid: ImageGrid) -> Figure:
    """A row for each scene, with the times in the pictures."""
    figure = rows_figure(grid, LEFT, TOP, grid.rows)
    for axes, time in zip(figure.axes, np.ravel(grid.numbers["times"]), strict=True):
        axes.text(0.03, 0.97, time, transform=axes.transAxes, fontsize=6, va="top", color=style.GREY)
    return figure


def _shown(obstacle: Obstacle, middle: np.ndarray) -> Obstacle:
    """An obstacle with the opacity of glass, if it surrounds the middle (3,) [m] of the body."""
    vertices = obstacle.placed(0)
    surrounds = ((vertices.min(axis=0) < middle) & (middle < vertices.max(axis=0))).all()
    return replace(obstacle, opacity=GLASS) if surrounds else obstacle


def _pictures(body, around: list[Obstacle], params) -> np.ndarray:
    """Pictures (T, H, W, 3) of a body, obstacles and the floor."""
    square = FLOOR_REACH * np.array([[-1.0, 0, -1], [-1, 0, 1], [1, 0, 1], [1, 0, -1]])
    frames = len(around[0].poses)
    floor = Obstacle(square, np.array([[0, 1, 2], [0, 2, 3]]), np.tile(np.eye(4), (frames, 1, 1)), FLOOR)
    seen = np.concatenate([body.points, *(each.placed(k) for each in around for k in range(frames))])
    view = framing([DIRECTION / np.linalg.norm(DIRECTION)], seen, params.size, params.size)
    names = [f"{k}.png" for k in range(frames)]
    with tempfile.TemporaryDirectory(prefix="neuma-obstacles-") as folder:
        shots = [(k, 0) for k in range(frames)]
        extra = {"obstacles": [*around, floor], "matte": False}
        render_images(body, view, shots, folder, names, params.samples, params.threads, **extra)
        pictures = [np.asarray(Image.open(Path(folder, name)), dtype=float) for name in names]
    colours, share = np.stack(pictures)[..., :3], np.stack(pictures)[..., 3:] / 255
    return (colours * share + 255 * (1 - share)).round().astype(np.uint8)
