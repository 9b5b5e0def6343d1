"""Share of truths inside the intervals of constants and predicted motions at each level, over the random scenes. On the
diagonal, intervals have the coverage that they state. Shaded: 95 % confidence by a bootstrap over the scenes. Not in
the paper.
"""

from collections.abc import Mapping

from matplotlib.figure import Figure

from neuma_lib.evaluation.calibration import LEVELS
from neuma_lib.evaluation.plotting import style
from neuma_lib.io.files import read_json
from neuma_lib.paper.calibration_table import reliability


def data(inputs, params, log) -> dict:
    """Curves by quantity and method, see `reliability`."""
    curves = reliability(list(map(read_json, inputs.records)))
    log(f"{len(inputs.records)} scenes, {', '.join(curves)}")
    return curves


@style.styled
def draw(data: Mapping) -> Figure:
    """A square panel for each quantity, with the diagonal."""
    rows = -(-len(data) // 2)
    figure = style.new_figure(style.PAGE, rows * 0.5 * style.PAGE + 0.3)
    panels = figure.subplots(rows, 2, squeeze=False, sharex=True, sharey=True)
    for axes in panels.flat[len(data) :]:
        axes.set_axis_off()
    for axes, (quantity, methods) in zip(panels.flat, data.items(), strict=False):
        axes.plot([0, 100], [0, 100], color=style.GREY, linewidth=0.8)
        levels = [100 * level for level in LEVELS]
        for k, (method, curve) in enumerate(methods.items()):
            low, middle, high = (
                [100 * share for share in curve[key]] for key in ("covered_low", "covered", "covered_high")
            )
            color = style.SEQUENCE[k % len(style.SEQUENCE)]
            axes.fill_between(levels, low, high, color=color, alpha=0.18, linewidth=0)
            axes.plot(levels, middle, color=color, label=method)
        axes.set(xlim=(0, 100), ylim=(0, 100), aspect="equal", title=quantity.replace("_", " "))
        axes.grid()
    used = panels.flat[: len(data)]
    for axes in used[-2:]:
        axes.set_xlabel("level [%]")
        axes.tick_params(labelbottom=True)
    for axes in used[::2]:
        axes.set_ylabel("truths inside [%]")
    style.legend_above(figure, panels.flat[0], 3)
    return figure
