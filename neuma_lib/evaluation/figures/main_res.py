"""Renders over time: the observation, NeuMA and its ablations (paper, fig:main_res)."""

from __future__ import annotations

from matplotlib.figure import Figure

from neuma_lib.evaluation.figures import style
from neuma_lib.evaluation.figures.grid import image_grid, note, picture_height
from neuma_lib.evaluation.figures.panels import Panels

LEFT, TOP, BETWEEN = 0.92, 0.3, 0.06


@style.styled
def draw(panels: Panels) -> Figure:
    """Draw one block of columns a scene.

    Args:
        panels: a row for the observation and each method; ``groups`` in the numbers: (scene, its columns) in order.
    """
    groups = panels.numbers["groups"]
    width = (style.PAGE - LEFT - BETWEEN * (len(groups) - 1)) / len(panels.columns)
    height = picture_height(panels.images, 1, width)
    figure = style.new_canvas(style.PAGE, TOP + len(panels.rows) * (height + 0.02) + 0.03)
    left, first = LEFT, 0
    for scene, count in groups:
        part = slice(first, first + count)
        note(figure, left + count * width / 2, 0.09, scene, ha="center", fontweight="bold")
        rows = panels.rows if first == 0 else ()
        image_grid(figure, panels.images[:, part], left, TOP, count * width, rows, panels.columns[part])
        left, first = left + count * width + BETWEEN, first + count
    return figure
