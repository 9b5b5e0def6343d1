"""Splats from an image-to-3D model or from photographs, simulated with laws learned from videos of other objects.
Particles fill the surface that renders of the splat show, and move its Gaussians. Left: the initial state. Paper:
fig:i23d.
"""

import numpy as np
import torch
from matplotlib.figure import Figure

from neuma_lib.evaluation.plotting import rendering, style
from neuma_lib.io.files import read_json
from neuma_lib.io.hdf5 import read_arrays
from neuma_lib.io.particles import load_motion
from neuma_lib.paper.image_grid import ImageGrid, rows_figure

LEFT, TOP = 1.05, 0.2


def data(inputs, params, log) -> ImageGrid:
    """Rows are splats, each with all laws. Columns are times.

    Numbers: ``laws``, number of rows of a splat; ``diverged``, rows with a prediction that stopped early.
    """
    laws, splats = len(params.laws), list(params.splats)
    bodies = rendering.bodies(inputs, gaussian_motion="affine")
    motions, times = [], []
    for file in inputs.rollouts:
        arrays, attributes = read_arrays(file, required=("frames",), only=("frames",))
        picked = rendering.evenly(params.shown, len(arrays["frames"]))
        motions.append([torch.as_tensor(state[picked]) for state in load_motion(file)])
        times.append(rendering.milliseconds(arrays["frames"][picked], attributes["dt"]))
    around = [rendering.seen_around(bodies[k // laws], *motion) for k, motion in enumerate(motions)]
    clouds = [np.concatenate(around[k : k + laws]) for k in range(0, len(around), laws)]
    width, height = rendering.picture_size(
        *np.max([np.ptp(cloud, axis=0)[:2] for cloud in clouds], axis=0), params.size
    )
    cameras = [rendering.frontal(cloud, width, height) for cloud in clouds]
    pictures = [
        rendering.renders(bodies[k // laws], cameras[k // laws], *motion) for k, motion in enumerate(motions)
    ]
    diverged = [k for k, file in enumerate(inputs.reports) if read_json(file)["diverged"]]
    log(f"{len(splats)} splats under {laws} laws" + (f"; {len(diverged)} broke off" if diverged else ""))
    titles = [f"{splat}, {law}" for splat in splats for law in params.laws]
    groups = [np.stack(pictures[k : k + laws]) for k in range(0, len(pictures), laws)]
    numbers = {"laws": laws, "diverged": diverged}
    return ImageGrid(np.concatenate(rendering.cropped(groups)), tuple(titles), tuple(times[0]), numbers)


@style.styled
def draw(grid: ImageGrid) -> Figure:
    """A row for each splat and law. Predictions that stopped early are marked."""
    titles = [
        title + (", broke off" if k in grid.numbers["diverged"] else "") for k, title in enumerate(grid.rows)
    ]
    return rows_figure(grid, LEFT, TOP, titles)
