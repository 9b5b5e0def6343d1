"""Prediction beyond the video: renders, and the mean height against the truth (paper, fig:ext_time)."""

from __future__ import annotations

import numpy as np
from matplotlib.figure import Figure

from neuma_lib.evaluation.figures import style
from neuma_lib.evaluation.figures.grid import image_grid, picture_height, place
from neuma_lib.evaluation.figures.panels import Panels

LEFT, TOP, CURVE = 0.92, 0.2, 1.3


@style.styled
def draw(panels: Panels) -> Figure:
    """Draw a row a method above the curves of all.

    Args:
        panels: columns are times. Numbers: ``observed`` [s], ``time`` [s], ``titles`` and ``heights`` [m] by method,
            "truth" among them.
    """
    numbers = panels.numbers
    width = style.PAGE - LEFT - 0.02
    height = picture_height(panels.images, len(panels.columns), width)
    below = TOP + len(panels.rows) * (height + 0.02) + 0.12
    figure = style.new_canvas(style.PAGE, below + CURVE + 0.36)
    image_grid(figure, panels.images, LEFT, TOP, width, panels.rows, panels.columns)
    axes = place(figure, LEFT, below, width, CURVE)
    time, seen = 1e3 * np.asarray(numbers["time"]), 1e3 * numbers["observed"]
    axes.axvspan(0, seen, color=style.LIGHT, linewidth=0)
    for method, heights in numbers["heights"].items():
        axes.plot(time, heights, label=numbers["titles"][method], **style.look(method).line)
    axes.text(seen / 2, 0.03, "observed", transform=axes.get_xaxis_transform(), ha="center", va="bottom")
    axes.text(
        (seen + time[-1]) / 2,
        0.03,
        "predicted",
        transform=axes.get_xaxis_transform(),
        ha="center",
        va="bottom",
    )
    axes.set(xlabel="time [ms]", ylabel="mean height [m]", xlim=(0, time[-1]))
    axes.margins(y=0.15)
    axes.legend(loc="upper right", ncols=len(numbers["heights"]))
    return figure
