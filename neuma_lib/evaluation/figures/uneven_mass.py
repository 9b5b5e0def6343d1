"""An object of two densities: told to the reconstruction, and not told (paper, fig:uneven_mass)."""

from __future__ import annotations

from matplotlib.figure import Figure

from neuma_lib.evaluation.figures import style
from neuma_lib.evaluation.figures.grid import image_grid, note, picture_height, place
from neuma_lib.evaluation.figures.panels import Panels

LEFT, TOP, BARS = 0.98, 0.2, 1.25
PAPER = 1.33
"""Chamfer distance of the paper [1e-4 m^2], which contains a sampling floor of its own."""


@style.styled
def draw(panels: Panels) -> Figure:
    """Draw rows of pictures and the Chamfer distance of each prediction beside its row.

    Args:
        panels: columns are times. Numbers: ``rows`` {method: row}, ``chamfer`` {method: 1e-4 m^2}, ``floor``.
    """
    numbers = panels.numbers
    width = style.PAGE - LEFT - BARS - 0.2
    height = picture_height(panels.images, len(panels.columns), width)
    figure = style.new_canvas(style.PAGE, TOP + len(panels.rows) * (height + 0.02) + 0.36)
    image_grid(figure, panels.images, LEFT, TOP, width, panels.rows, panels.columns)
    axes = place(figure, LEFT + width + 0.1, TOP, BARS, len(panels.rows) * (height + 0.02))
    for method, value in numbers["chamfer"].items():
        axes.barh(
            numbers["rows"][method],
            value,
            height=0.4,
            color=style.SKY if "+" in method else style.look(method).color,
        )
        axes.text(value, numbers["rows"][method], f" {value:.2f}", ha="left", va="center")
    axes.axvline(numbers["floor"], color=style.BLACK, linewidth=0.8, linestyle=(0, (2, 1)))
    axes.text(numbers["floor"], -0.42, " floor", ha="left", va="top", fontsize=6.5)
    axes.set_xscale("log")
    axes.set_xlim(0.5 * numbers["floor"], 3 * max(numbers["chamfer"].values()))
    axes.xaxis.set_major_formatter("{x:g}")
    axes.set(ylim=(len(panels.rows) - 0.5, -0.5), xlabel="Chamfer distance [10⁻⁴ m²]", yticks=[])
    axes.spines["left"].set_visible(False)
    note(figure, LEFT + width + 0.1, 0.1, f"paper: {PAPER} with its floor", fontsize=6.5)
    return figure
