"""A cat of two densities. Top: the particles of NeuMA with the given densities. Below: the observation, and predictions
of methods that know the two densities or assume one. Bars: tracer RMSE and Chamfer distance (the paper's is 1.33, with
another floor). Paper: fig:uneven_mass.
"""

import numpy as np
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure

from neuma_lib.evaluation.plotting import rendering, style
from neuma_lib.io.files import read_json
from neuma_lib.io.particles import load_motion
from neuma_lib.paper.claims import shown
from neuma_lib.paper.image_grid import GAP, ImageGrid, draw_images, note, place

LEFT, TOP, BARS = 0.98, 0.2, 1.25
PAPER = 1.33  # Chamfer distance of the paper [1e-4 m^2], including the sampling floor of its particles


def data(inputs, params, log) -> ImageGrid:
    """Columns are times. Numbers: ``rows``, ``rmse`` [mm] and ``chamfer`` [1e-4 m^2] of each method, and ``floor``."""
    (setting,) = params.scene.values()
    video, body, cameras = rendering.film(inputs, params, 0, setting["density"])
    picked = rendering.evenly(params.shown, len(video.frames))
    motions = [[state[picked] for state in load_motion(file)] for file in inputs.rollouts]
    density = (body.mass / body.vol0).numpy()
    heavy = density > 0.5 * (density.min() + density.max())
    colors = np.where(heavy[:, None], to_rgb(style.ORANGE), to_rgb(style.SKY))
    known, _ = motions[list(params.titles).index("neuma")]
    pictures = [rendering.particle_pictures(known, colors, rendering.sphere_radius(body.vol0), cameras)]
    pictures.append(rendering.observed(video, picked, params.magnify))
    pictures += [rendering.renders(body, cameras, *motion) for motion in motions]
    rows = [f"NeuMA's particles:\n{density.max():.0f} (orange) and\n{density.min():.0f} kg/m³", "Observation"]
    metrics = dict(zip(params.titles, map(read_json, inputs.metrics), strict=True))
    numbers = {
        "rows": {method: 2 + k for k, method in enumerate(params.titles)},
        "rmse": {method: m["tracer_rmse_mm"] for method, m in metrics.items()},
        "chamfer": {method: m["chamfer"] for method, m in metrics.items()},
        "floor": next(iter(metrics.values()))["chamfer_floor"],
    }
    log(", ".join(f"{method}: RMSE {value:.1f} mm" for method, value in numbers["rmse"].items()))
    (images,) = rendering.cropped([np.stack(pictures)])
    columns = tuple(rendering.milliseconds([video.frames[i] for i in picked], setting["dt"]))
    return ImageGrid(images, (*rows, *params.titles.values()), columns, numbers)


@style.styled
def draw(grid: ImageGrid) -> Figure:
    """Rows of pictures, with the error of each prediction next to its row."""
    numbers = grid.numbers
    width = style.PAGE - LEFT - BARS - 0.2
    high = len(grid.rows) * (grid.height(width) + GAP)
    figure = style.new_canvas(style.PAGE, TOP + high + 0.36)
    draw_images(figure, grid.images, LEFT, TOP, width, grid.rows, grid.columns)
    axes = place(figure, LEFT + width + 0.1, TOP, BARS, high)
    for method, value in numbers["rmse"].items():
        row, color = numbers["rows"][method], style.SKY if "+" in method else style.look(method).color
        axes.barh(row, value, height=0.4, color=color)
        axes.text(
            0,
            row + 0.3,
            f"{value:.1f} mm\nChamfer {shown(numbers['chamfer'][method], 2)}",
            ha="left",
            va="top",
        )
    axes.set_xlim(0, 1.1 * max(numbers["rmse"].values()))
    axes.set(ylim=(len(grid.rows) - 0.5, -0.5), xlabel="tracer RMSE [mm]", yticks=[])
    axes.spines["left"].set_visible(False)
    distances = f"Chamfer [10⁻⁴ m²]:\nfloor {numbers['floor']:.2f}, paper {PAPER}"
    note(figure, LEFT + width + 0.1, 0.02, distances, fontsize=6.5, va="top")
    return figure
