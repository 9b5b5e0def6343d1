"""Chamfer distance over time, a panel a scene (paper, fig:ch_dist_curve)."""

from __future__ import annotations

import math
from collections.abc import Mapping

from matplotlib.figure import Figure

from neuma_lib.evaluation.figures import style

COLUMNS = 3


@style.styled
def draw(data: Mapping) -> Figure:
    """Draw the curves.

    Args:
        data: ``titles`` {method: name} and ``scenes`` {scene: {time [s], floor, chamfer {method: values}}}, distances
            in 1e-4 m^2.
    """
    scenes = data["scenes"]
    columns = min(COLUMNS, len(scenes))
    rows = math.ceil(len(scenes) / columns)
    figure = style.new_figure(style.PAGE if columns > 1 else style.COLUMN, 0.45 + 1.45 * rows)
    panels = figure.subplots(rows, columns, squeeze=False)
    for axes in panels.flat[len(scenes) :]:
        axes.set_axis_off()
    for axes, (scene, values) in zip(panels.flat, scenes.items()):
        time = [1e3 * t for t in values["time"]]
        for method, title in data["titles"].items():
            axes.plot(time, values["chamfer"][method], label=title, **style.look(method).line)
        axes.fill_between(
            time, values["floor"], 1e-6, color=style.LIGHT, linewidth=0, label="below the sampling floor"
        )
        lowest = min(min(values["floor"]), *(min(c) for c in values["chamfer"].values()))
        axes.set(yscale="log", title=scene, xlim=(0, time[-1]))
        axes.set_ylim(bottom=0.6 * lowest)
        axes.grid(axis="y")
    for axes in panels[-1]:
        axes.set_xlabel("time [ms]")
    for axes in panels[:, 0]:
        axes.set_ylabel("Chamfer distance [10⁻⁴ m²]")
    style.legend_above(figure, panels[0, 0], 3 if columns > 1 else 2)
    return figure
