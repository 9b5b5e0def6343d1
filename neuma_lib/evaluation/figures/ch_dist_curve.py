"""Chamfer distance between predicted and true motion over time, all methods and scenes, measured on dense passive
tracers. Grey: below the sampling floor, the distance of two samplings of the truth itself, nothing can be measured. All
curves start there, because motion before contact is the same for every material. Paper: fig:ch_dist_curve.
"""

from __future__ import annotations

import math
from collections.abc import Mapping

from matplotlib.figure import Figure

from neuma_lib.evaluation.plotting import style
from neuma_lib.evaluation.results import read_results

COLUMNS = 3


def data(inputs, params, say) -> dict:
    """``titles`` {method: name} and ``scenes`` {scene: {time [s], floor, chamfer {method: values}}} [1e-4 m^2]."""
    metrics = read_results(inputs.metrics, params.titles, params.scenes)
    first = metrics[next(iter(params.titles))]
    scenes = {
        scene: {
            "time": [dt * step for step in first[scene]["frames"]],
            "floor": first[scene]["chamfer_floor_per_frame"],
            "chamfer": {method: row[scene]["chamfer_per_frame"] for method, row in metrics.items()},
        }
        for scene, dt in params.scenes.items()
    }
    say(f"{len(params.titles)} methods on {len(scenes)} scenes")
    return {"titles": params.titles, "scenes": scenes}


@style.styled
def draw(data: Mapping) -> Figure:
    """One panel a scene."""
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
        below = {"color": style.LIGHT, "linewidth": 0, "label": "below the sampling floor"}
        axes.fill_between(time, values["floor"], 1e-6, **below)
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
