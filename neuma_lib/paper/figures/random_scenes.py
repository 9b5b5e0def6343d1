"""Scenes drawn at random: error of the prior against that of the adapted law, a point a scene. Below the diagonal,
adaptation helps. Crosses: something failed. Not in the paper.
"""

from collections.abc import Mapping

from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, NullFormatter

from neuma_lib.evaluation.plotting import style
from neuma_lib.paper.random_scenes import failure
from neuma_lib.paper.results import read_results

MARKERS = "os^Dv*P"


def data(inputs, params, log) -> dict:
    """``titles`` of prior and method, ``families`` {family: scenes}, scenes as {scene: [errors [mm], failed]}."""
    metrics = read_results(inputs.metrics, params.titles, params.scenes)
    families: dict[str, dict] = {}
    for scene, known in params.scenes.items():
        runs = [row[scene] for row in metrics.values()]
        point = [[run["tracer_rmse_mm"] for run in runs], any(map(failure, runs))]
        families.setdefault(known["family"], {})[scene] = point
    log(f"{len(params.scenes)} scenes of {len(families)} families")
    return {"titles": list(params.titles.values()), "families": families}


@style.styled
def draw(data: Mapping) -> Figure:
    """A square panel with logarithmic axes and the diagonal."""
    figure = style.new_figure(style.COLUMN, style.COLUMN + 0.6)
    axes = figure.subplots()
    values = [v for scenes in data["families"].values() for point, _ in scenes.values() for v in point]
    low, high = min(values) / 1.5, max(values) * 1.5
    axes.plot([low, high], [low, high], color=style.GREY, linewidth=0.8)
    for k, (family, scenes) in enumerate(sorted(data["families"].items())):
        look = {"color": style.SEQUENCE[k % len(style.SEQUENCE)], "linestyle": ""}
        x, y = zip(*(point for point, _ in scenes.values()))
        axes.plot(x, y, MARKERS[k % len(MARKERS)], label=family.replace("_", " "), **look)
        broken = [point for point, failed in scenes.values() if failed]
        if broken:
            axes.plot(*zip(*broken), "x", color=style.BLACK, markersize=6)
    prior, method = data["titles"]
    axes.set(xscale="log", yscale="log", xlim=(low, high), ylim=(low, high), aspect="equal")
    for axis in (axes.xaxis, axes.yaxis):
        axis.set_major_locator(LogLocator(subs=(1, 2, 5)))
        axis.set_major_formatter("{x:g}")
        axis.set_minor_formatter(NullFormatter())
    axes.set(xlabel=f"{prior}: tracer RMSE [mm]", ylabel=f"{method}: tracer RMSE [mm]")
    axes.grid()
    style.legend_above(figure, axes, 2)
    return figure
