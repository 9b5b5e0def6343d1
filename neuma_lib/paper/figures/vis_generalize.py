"""Trained materials applied to other bodies. (a) The letters of NeurIPS, with particles and Gaussians sampled from the
glyph. Blue: the scene in which the material was learned. (b) Scenes of several objects on one grid, each with the law
learned from its own video. Paper: fig:vis_generalize, with distances in table 2.
"""

import numpy as np
from matplotlib.figure import Figure

from neuma_lib.evaluation.plotting import rendering, style
from neuma_lib.io.hdf5 import read_arrays
from neuma_lib.io.particles import load_motion
from neuma_lib.paper.image_grid import GAP, ImageGrid, draw_images, note

LEFT, TOP, BETWEEN = 0.92, 0.36, 0.42


def data(inputs, params, log) -> ImageGrid:
    """Rows are the times of (a), with a column for each letter, then the scenes of (b), with a column for each time.

    Numbers: ``letters``, number of rows of (a); ``materials``, of the letters; ``times``, column titles of (b).
    """
    paths = [read_arrays(file, required=("x", "frames"), only=("x", "frames")) for file in inputs.rollouts]
    bodies = rendering.bodies(inputs)
    letters, count = len(params.letters), len(params.letters) or params.shown
    points = np.concatenate([arrays["x"].reshape(-1, 3) for arrays, _ in paths[:letters] or paths])
    width, height = rendering.picture_size(*np.ptp(points, axis=0)[:2], params.size)

    def filmed(k: int, cameras, picked) -> np.ndarray:
        motion = load_motion(inputs.rollouts[k])
        return rendering.renders(bodies[k], cameras, *(state[picked] for state in motion))

    rows, titles, times = [], [], []
    if letters:
        steps = [len(arrays["x"]) for arrays, _ in paths[:letters]]
        cameras = rendering.frontal(points, width, height)
        columns = [filmed(k, cameras, rendering.evenly(params.shown, steps[k])) for k in range(letters)]
        rows += list(np.stack(columns, axis=1))
        last = min(len(column) for column in columns) - 1
        titles += [f"{100 * i / last:.0f} % of\nthe sequence" for i in range(last + 1)]
    split = len(rows)
    for k, title in enumerate(params.others.values(), start=letters):
        arrays, attributes = paths[k]
        picked = rendering.evenly(count, len(arrays["x"]))
        rows.append(filmed(k, rendering.frontal(arrays["x"], width, height), picked))
        titles.append(title)
        times.append(rendering.milliseconds(arrays["frames"][picked], attributes["dt"]))
    numbers = {
        "letters": split,
        "materials": [entry["material"] for entry in params.letters],
        "times": times[0] if times else [],
    }
    log(f"{letters} letters, {len(params.others)} scenes of several bodies")
    columns = [entry["letter"] for entry in params.letters] or times[0]
    return ImageGrid(np.stack(rows), tuple(titles), tuple(columns), numbers)


@style.styled
def draw(grid: ImageGrid) -> Figure:
    """(a) letters in columns, time downwards, above (b) scenes of several bodies, time to the right."""
    numbers = grid.numbers
    split = numbers["letters"]
    width = style.PAGE - LEFT - 0.02
    each = width / len(grid.columns)
    height = grid.height(width) + GAP
    second = TOP + split * height + BETWEEN
    rest = len(grid.rows) - split
    figure = style.new_canvas(style.PAGE, (second + rest * height if rest else second - BETWEEN) + 0.03)
    note(figure, 0.05, 0.1, "(a)", fontweight="bold")
    draw_images(figure, grid.images[:split], LEFT, TOP, width, grid.rows[:split])
    for j, (letter, material) in enumerate(zip(grid.columns, numbers["materials"])):
        middle = LEFT + (j + 0.5) * each
        note(figure, middle, 0.1, letter, ha="center", fontweight="bold")
        note(figure, middle, 0.25, material, ha="center", color=style.BLUE, fontsize=6.5)
    if rest:
        note(figure, 0.05, second - 0.22, "(b)", fontweight="bold")
        draw_images(figure, grid.images[split:], LEFT, second, width, grid.rows[split:], numbers["times"])
    return figure
