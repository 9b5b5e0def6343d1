"""Errors over time of all methods and scenes, measured with dense passive tracers. Above: root mean square distance of
tracers with the same start in truth and prediction. Below: the paper's Chamfer distance between predicted and true
body, which compares shapes only. Grey: below the sampling floor, the distance between two random samples of the true
body. Before contact, the motion does not depend on the material. Paper: fig:ch_dist_curve (Chamfer distances).
"""

import math
from collections.abc import Mapping

from matplotlib.figure import Figure

from neuma_lib.evaluation.plotting import style
from neuma_lib.paper.results import read_results

COLUMNS = 3


def data(inputs, params, log) -> dict:
    """``titles`` {method: name}, ``scenes`` {scene: numbers}.

    Numbers of a scene: time [s], floor [1e-4 m^2], and {method: values} as rmse [mm] and chamfer [1e-4 m^2].
    """
    metrics = read_results(inputs.metrics, params.titles, params.scenes)
    first = metrics[next(iter(params.titles))]
    scenes = {
        scene: {
            "time": [dt * step for step in first[scene]["frames"]],
            "floor": first[scene]["chamfer_floor_per_frame"],
            "rmse": {method: row[scene]["tracer_rmse_mm_per_frame"] for method, row in metrics.items()},
            "chamfer": {method: row[scene]["chamfer_per_frame"] for method, row in metrics.items()},
        }
        for scene, dt in params.scenes.items()
    }
    log(f"{len(params.titles)} methods on {len(scenes)} scenes")
    return {"titles": params.titles, "scenes": scenes}


@style.styled
def draw(data: Mapping) -> Figure:
    """Two panels for each scene: rows of errors, and rows of distances below them."""
    scenes = data["scenes"]
    columns = min(COLUMNS, len(scenes))
    rows = math.ceil(len(scenes) / columns)
    figure = style.new_figure(style.PAGE if columns > 1 else style.COLUMN, 0.45 + 2 * 1.35 * rows)
    panels = figure.subplots(2 * rows, columns, squeeze=False)
    errors, distances = panels[:rows], panels[rows:]
    for part in (errors, distances):
        for axes in part.flat[len(scenes) :]:
            axes.set_axis_off()
    for above, axes, (scene, values) in zip(errors.flat, distances.flat, scenes.items()):
        time = [1e3 * t for t in values["time"]]
        for method, title in data["titles"].items():
            above.plot(time, values["rmse"][method], label=title, **style.look(method).line)
            axes.plot(time, values["chamfer"][method], label=title, **style.look(method).line)
        below = {"color": style.LIGHT, "linewidth": 0, "label": "below the sampling floor"}
        axes.fill_between(time, values["floor"], 1e-6, **below)
        lowest = min(min(values["floor"]), *(min(c) for c in values["chamfer"].values()))
        above.set(title=scene, xlim=(0, time[-1]))
        above.set_ylim(bottom=0)
        axes.set(yscale="log", title=scene, xlim=(0, time[-1]))
        axes.set_ylim(bottom=0.6 * lowest)
        above.grid(axis="y")
        axes.grid(axis="y")
    for axes in panels[-1]:
        axes.set_xlabel("time [ms]")
    for part, label in ((errors, "tracer RMSE [mm]"), (distances, "Chamfer [10⁻⁴ m²]")):
        for axes in part[:, 0]:
            axes.set_ylabel(label)
    style.legend_above(figure, distances[0, 0], 3 if columns > 1 else 2)
    return figure
