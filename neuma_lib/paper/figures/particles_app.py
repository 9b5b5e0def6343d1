"""Particles of one scene predicted by all methods, and those of the ground truth. Time increases to the right. Colours
are those of the methods in all figures. Paper: fig:particles_app.
"""

import numpy as np
from matplotlib.figure import Figure

from neuma_lib.evaluation.plotting import rendering, style
from neuma_lib.io.hdf5 import read_arrays
from neuma_lib.paper.image_grid import ImageGrid, rows_figure

LEFT, TOP = 0.92, 0.18


def data(inputs, params, log) -> ImageGrid:
    """A row for the truth and each method, a column for each time."""
    truth, _ = read_arrays(inputs.truth, required=("x", "vol0"), only=("x", "vol0", "frames"))
    simulated, _ = read_arrays(inputs.particles, required=("vol0",), only=("vol0",))
    picked = rendering.evenly(params.shown, len(truth["x"]))
    paths = {"truth": truth["x"][picked]}
    for method, file in zip(params.titles, inputs.rollouts, strict=True):
        paths[method] = read_arrays(file, required=("x",), only=("x",))[0]["x"][picked]
    cameras = rendering.frontal(
        np.concatenate([x.reshape(-1, 3) for x in paths.values()]), params.size, params.size
    )
    rows = []
    for method, x in paths.items():
        color = style.TRUE_PARTICLES if method == "truth" else style.look(method).color
        vol0 = truth["vol0"] if method == "truth" else simulated["vol0"]
        rows.append(rendering.particle_pictures(x, color, rendering.sphere_radius(vol0), cameras))
    (images,) = rendering.cropped([np.stack(rows)])
    log(f"{images.shape[0]} x {images.shape[1]} pictures")
    columns = tuple(rendering.milliseconds(truth["frames"][picked], params.dt))
    return ImageGrid(images, ("Truth", *params.titles.values()), columns)


@style.styled
def draw(grid: ImageGrid) -> Figure:
    """A row for each method, a column for each time."""
    return rows_figure(grid, LEFT, TOP, grid.rows)
