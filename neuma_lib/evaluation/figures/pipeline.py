"""One scene through all stages, made of its own intermediate results (paper, fig:structure)."""

from __future__ import annotations

from matplotlib.figure import Figure
from matplotlib.patches import FancyArrowPatch

from neuma_lib.evaluation.figures import style
from neuma_lib.evaluation.figures.grid import image_grid, note, picture_height
from neuma_lib.evaluation.figures.panels import Panels

LEFT, RIGHT, HEAD, TITLES = 0.8, 0.42, 0.2, 0.16


@style.styled
def draw(panels: Panels) -> Figure:
    """Draw a row a stage, arrows between them, and the gradient's way back.

    Args:
        panels: rows: initial state, simulation, rendering, observation, difference. Numbers: ``first``, titles of the
            pictures of the first row; ``heads``, what happens before each row.
    """
    numbers = panels.numbers
    count = len(panels.columns)
    width = style.PAGE - LEFT - RIGHT
    height = picture_height(panels.images, count, width)
    figure = style.new_canvas(style.PAGE, len(panels.rows) * (height + HEAD) + 2 * TITLES + 0.05)
    middles, top = [], 0.0
    for i, row in enumerate(panels.rows):
        titles = numbers["first"] if i == 0 else panels.columns if i == 1 else ()
        note(figure, LEFT + width / 2, top + 0.1, numbers["heads"][i], ha="center", color=style.BLUE)
        top += HEAD + (TITLES if titles else 0)
        image_grid(figure, panels.images[i : i + 1], LEFT, top, width, (), titles)
        stage, _, text = row.partition("\n")
        note(figure, 0.03, top + height / 2, f"$\\bf{{{stage}}}$\n{text}", linespacing=1.4, fontsize=6.5)
        middles.append(top + height / 2)
        top += height
    for j in range(1, count):
        x = LEFT + j * width / count
        for row in (0, 1):
            _arrow(figure, (x - 0.09, middles[row]), (x + 0.09, middles[row]))
    x = LEFT + width + 0.03
    _arrow(figure, (x, middles[-1]), (x, middles[1]), color=style.VERMILION, bend=0.06)
    note(
        figure, style.PAGE - 0.08, (middles[-1] + middles[1]) / 2, "gradient to the adaptor ΔM",
        rotation=90, ha="center", color=style.VERMILION,
    )  # fmt: skip
    return figure


def _arrow(figure: Figure, start, end, color: str = style.GREY, bend: float = 0.0) -> None:
    """An arrow between two points, inches from the upper left corner."""
    width, height = figure.get_size_inches()
    ends = [(x / width, 1 - y / height) for x, y in (start, end)]
    figure.add_artist(
        FancyArrowPatch(
            *ends,
            arrowstyle="-|>",
            mutation_scale=7,
            color=color,
            linewidth=1.0,
            connectionstyle=f"arc3,rad={bend}",
            transform=figure.transFigure,
            zorder=5,
        )
    )
