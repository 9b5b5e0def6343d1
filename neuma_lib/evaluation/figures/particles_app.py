"""Simulated particles of all variants against the true ones (paper, fig:particles_app)."""

from __future__ import annotations

from matplotlib.figure import Figure

from neuma_lib.evaluation.figures import style
from neuma_lib.evaluation.figures.grid import image_grid, picture_height
from neuma_lib.evaluation.figures.panels import Panels

LEFT, TOP = 0.92, 0.18


@style.styled
def draw(panels: Panels) -> Figure:
    """Draw a row a method and a column a time."""
    width = style.PAGE - LEFT - 0.02
    height = picture_height(panels.images, len(panels.columns), width)
    figure = style.new_canvas(style.PAGE, TOP + len(panels.rows) * (height + 0.02) + 0.03)
    image_grid(figure, panels.images, LEFT, TOP, width, panels.rows, panels.columns)
    return figure
