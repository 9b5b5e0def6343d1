"""Trained materials on new objects and on several at once (paper, fig:vis_generalize)."""

from __future__ import annotations

from matplotlib.figure import Figure

from neuma_lib.evaluation.figures import style
from neuma_lib.evaluation.figures.grid import image_grid, note, picture_height
from neuma_lib.evaluation.figures.panels import Panels

LEFT, TOP, BETWEEN = 0.92, 0.36, 0.42


@style.styled
def draw(panels: Panels) -> Figure:
    """Draw (a) a letter a column, time downwards, above (b) scenes of several bodies, time to the right.

    Args:
        panels: the first ``letters`` rows (numbers) are times of (a), the others scenes of (b). Numbers further:
            ``materials``, one a letter, and ``times``, column titles of (b).
    """
    numbers = panels.numbers
    split = numbers["letters"]
    width = style.PAGE - LEFT - 0.02
    each = width / len(panels.columns)
    height = picture_height(panels.images, len(panels.columns), width) + 0.02
    second = TOP + split * height + BETWEEN
    rest = len(panels.rows) - split
    figure = style.new_canvas(style.PAGE, (second + rest * height if rest else second - BETWEEN) + 0.03)
    note(figure, 0.05, 0.1, "(a)", fontweight="bold")
    image_grid(figure, panels.images[:split], LEFT, TOP, width, panels.rows[:split])
    for j, (letter, material) in enumerate(zip(panels.columns, numbers["materials"])):
        middle = LEFT + (j + 0.5) * each
        note(figure, middle, 0.1, letter, ha="center", fontweight="bold")
        note(figure, middle, 0.25, material, ha="center", color=style.BLUE, fontsize=6.5)
    if rest:
        note(figure, 0.05, second - 0.22, "(b)", fontweight="bold")
        image_grid(figure, panels.images[split:], LEFT, second, width, panels.rows[split:], numbers["times"])
    return figure
