"""Between prior and observation: the adaptor with weights from 0 to 1 and a little beyond (paper, fig:lora_alphav)."""

from __future__ import annotations

import matplotlib
import numpy as np
from matplotlib.figure import Figure

from neuma_lib.evaluation.figures import style
from neuma_lib.evaluation.figures.grid import image_grid, note, picture_height, place
from neuma_lib.evaluation.figures.panels import Panels

LEFT, LEGEND, TITLE, PICTURES, CURVES, BETWEEN = 0.5, 0.2, 0.34, 4.0, 1.85, 0.38


@style.styled
def draw(panels: Panels) -> Figure:
    """Draw for each scene a column a weight, a row a time, and the mean heights beside them.

    Args:
        panels: rows scene by scene; columns are the weights and the observation. Numbers: ``weights`` and ``scenes``
            {scene: {rows, time [s], heights [m] a weight, truth [m]}}.
    """
    numbers = panels.numbers
    height = picture_height(panels.images, len(panels.columns), PICTURES)
    heights = [scene["rows"] * (height + 0.02) for scene in numbers["scenes"].values()]
    blocks = [max(h, 1.3) + TITLE + BETWEEN for h in heights]
    figure = style.new_canvas(style.PAGE, LEGEND + sum(blocks) + 0.03)
    weights = numbers["weights"]
    colors = matplotlib.colormaps[style.RAMP](np.linspace(0, 0.92, len(weights)))
    top, first = LEGEND, 0
    for (name, scene), block in zip(numbers["scenes"].items(), blocks):
        part = slice(first, first + scene["rows"])
        note(figure, LEFT, top + 0.09, name, fontweight="bold")
        image_grid(
            figure, panels.images[part], LEFT, top + TITLE, PICTURES, panels.rows[part], panels.columns
        )
        left = LEFT + PICTURES + 0.42
        axes = place(figure, left, top + 0.08, CURVES, block - 0.08 - BETWEEN)
        time = 1e3 * np.asarray(scene["time"])
        axes.plot(time, scene["truth"], "o", markersize=2.2, color=style.BLACK, label="truth")
        for weight, color, values in zip(weights, colors, scene["heights"]):
            dash = "-" if 0 <= weight <= 1 else (0, (2, 1))
            axes.plot(time, values, color=color, linestyle=dash, label=f"$w$ = {weight:g}")
        axes.set(xlabel="time [ms]", ylabel="mean height [m]", xlim=(0, time[-1]))
        axes.grid(axis="y")
        if first == 0:
            figure.legend(
                *axes.get_legend_handles_labels(),
                loc="upper center",
                ncols=len(weights) + 1,
                columnspacing=1.2,
                handlelength=1.6,
                borderaxespad=0.1,
            )
        top, first = top + block, first + scene["rows"]
    return figure
