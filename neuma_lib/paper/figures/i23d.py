"""Splats from an image-to-3D model or from photographs, simulated with laws learned from videos of other objects.
Particles fill the surface that renders of the splat show, and move its Gaussians. Left: the initial state. Paper:
fig:i23d.
"""

from __future__ import annotations

import numpy as np
import torch
from matplotlib.figure import Figure

from neuma_lib.evaluation.plotting import rendering, style
from neuma_lib.io.files import read_json
from neuma_lib.io.hdf5 import read_arrays
from neuma_lib.io.particles import load_motion, load_reconstruction
from neuma_lib.paper.image_grid import ImageGrid, rows_figure

LEFT, TOP = 1.05, 0.2
DENSITY = 1000.0
"""Density of all bodies [kg/m^3]. It does not affect the pictures."""


def data(inputs, params, log) -> ImageGrid:
    """Rows are splats, each with all laws. Columns are times.

    Numbers: ``laws``, number of rows of a splat; ``diverged``, rows with a prediction that stopped early.
    """
    laws, splats = len(params.laws), list(params.splats)
    files = zip(inputs.particles, inputs.binding, inputs.gaussians, strict=True)
    bodies = [load_reconstruction(*of_body, DENSITY, gaussian_motion="affine") for of_body in files]
    paths = [read_arrays(file, required=("frames",), only=("frames",)) for file in inputs.rollouts]
    motions = []
    for file, (arrays, _) in zip(inputs.rollouts, paths, strict=True):
        picked = rendering.evenly(params.shown, len(arrays["frames"]))
        motions.append([torch.as_tensor(state[picked]) for state in load_motion(file)])
    around = [rendering.seen_around(bodies[k // laws], *motion) for k, motion in enumerate(motions)]
    clouds = [np.concatenate(around[k : k + laws]) for k in range(0, len(around), laws)]
    width, height = rendering.picture_size(
        *np.max([np.ptp(cloud, axis=0)[:2] for cloud in clouds], axis=0), params.size
    )
    pictures, times = [], []
    for k, (arrays, attributes) in enumerate(paths):
        body, cameras = bodies[k // laws], rendering.frontal(clouds[k // laws], width, height)
        picked = rendering.evenly(params.shown, len(arrays["frames"]))
        pictures.append(rendering.renders(body, cameras, *motions[k]))
        times = times or rendering.milliseconds(arrays["frames"][picked], attributes["dt"])
    diverged = [k for k, file in enumerate(inputs.reports) if read_json(file)["diverged"]]
    log(f"{len(splats)} splats under {laws} laws" + (f"; {len(diverged)} broke off" if diverged else ""))
    titles = [f"{splat}, {law}" for splat in splats for law in params.laws]
    groups = [np.stack(pictures[k : k + laws]) for k in range(0, len(pictures), laws)]
    numbers = {"laws": laws, "diverged": diverged}
    return ImageGrid(np.concatenate(rendering.cropped(groups)), tuple(titles), tuple(times), numbers)


@style.styled
def draw(grid: ImageGrid) -> Figure:
    """A row for each splat and law. Predictions that stopped early are marked."""
    titles = [
        title + (", broke off" if k in grid.numbers["diverged"] else "") for k, title in enumerate(grid.rows)
    ]
    return rows_figure(grid, LEFT, TOP, titles)
