"""Prediction three times as long as the video: particles of the truth, renders with the prior and with trained laws,
and the mean height of the body over time. Grey: the observed part. Paper: fig:ext_time.
"""

import numpy as np
from matplotlib.figure import Figure

from neuma_lib.evaluation.metrics import mean_height
from neuma_lib.evaluation.plotting import rendering, style
from neuma_lib.io.hdf5 import read_arrays
from neuma_lib.io.particles import load_motion, load_reconstruction
from neuma_lib.paper.image_grid import GAP, ImageGrid, draw_images, place

LEFT, TOP, CURVE = 0.92, 0.2, 1.3


def data(inputs, params, log) -> ImageGrid:
    """Columns are times, rows the truth and the methods.

    Numbers: ``observed`` [s], ``time`` [s], ``titles`` and ``heights`` [m] by method, including "truth".
    """
    names = ("x", "mass", "vol0", "frames")
    truth, attributes = read_arrays(inputs.truth, required=names, only=names)
    body = load_reconstruction(inputs.particles, inputs.binding, inputs.gaussians, params.density)
    picked = rendering.evenly(params.shown, len(truth["frames"]))
    motions = [load_motion(file) for file in inputs.rollouts]
    everywhere = [np.asarray(x).reshape(-1, 3) for x in (truth["x"], *(x for x, _ in motions))]
    cameras = rendering.frontal(np.concatenate(everywhere), params.size, params.size)
    rows = [
        rendering.particle_pictures(
            truth["x"][picked], style.TRUE_PARTICLES, rendering.sphere_radius(truth["vol0"]), cameras
        )
    ]
    heights = {"truth": mean_height(truth["x"], truth["mass"])}
    for method, (x, F) in zip(params.titles, motions, strict=True):
        rows.append(rendering.renders(body, cameras, x[picked], F[picked]))
        heights[method] = mean_height(x, body.mass)
    dt = attributes["dt"]
    numbers = {
        "observed": params.observed,
        "time": [dt * int(step) for step in truth["frames"]],
        "titles": {"truth": "Truth", **params.titles},
        "heights": heights,
    }
    (images,) = rendering.cropped([np.stack(rows)])
    for method in params.titles:
        far = max(abs(a - b) for a, b in zip(heights["truth"], heights[method], strict=True))
        log(f"{method}: mean height within {1e3 * far:.1f} mm of the truth")
    columns = tuple(rendering.milliseconds(truth["frames"][picked], dt))
    return ImageGrid(images, ("Truth (particles)", *params.titles.values()), columns, numbers)


@style.styled
def draw(grid: ImageGrid) -> Figure:
    """A row for each method above the curves of all."""
    numbers = grid.numbers
    width = style.PAGE - LEFT - 0.02
    below = TOP + len(grid.rows) * (grid.height(width) + GAP) + 0.12
    figure = style.new_canvas(style.PAGE, below + CURVE + 0.36)
    draw_images(figure, grid.images, LEFT, TOP, width, grid.rows, grid.columns)
    axes = place(figure, LEFT, below, width, CURVE)
    time, seen = 1e3 * np.asarray(numbers["time"]), 1e3 * numbers["observed"]
    axes.axvspan(0, seen, color=style.LIGHT, linewidth=0)
    for method, heights in numbers["heights"].items():
        axes.plot(time, heights, label=numbers["titles"][method], **style.look(method).line)
    for middle, text in ((seen / 2, "observed"), ((seen + time[-1]) / 2, "predicted")):
        axes.text(middle, 0.03, text, transform=axes.get_xaxis_transform(), ha="center", va="bottom")
    axes.set(xlabel="time [ms]", ylabel="mean height [m]", xlim=(0, time[-1]))
    axes.margins(y=0.15)
    axes.legend(loc="upper right", ncols=len(numbers["heights"]))
    return figure
