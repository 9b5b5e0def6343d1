"""What the laws are: stress against stretch and shear of prior, learned and true law (not in the paper)."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from neuma_lib.evaluation.figures import style

LAWS = {"truth": "true law", "nclaw": "prior", "neuma": "NeuMA"}
TESTS = {
    "uniaxial": ("axial stretch", "axial stress"),
    "shear": ("elastic shear", "shear stress"),
    "yield": ("total shear", "shear stress"),
}
VISITED = "#d9e6ef"


@style.styled
def draw(data: Mapping) -> Figure:
    """Draw a column a scene and a row a test.

    Args:
        data: scene -> test of `TESTS` -> {``x``, ``stress`` [Pa] {law: values}, ``visited`` (low, high) of x, and for
            the test of yielding of the stress}.
    """
    scenes = list(data)
    figure = style.new_figure(style.PAGE if len(scenes) > 2 else style.COLUMN, 0.35 + 1.25 * len(TESTS))
    panels = figure.subplots(len(TESTS), len(scenes), squeeze=False)
    for column, scene in zip(panels.T, scenes):
        column[0].set_title(scene)
        for axes, test in zip(column, TESTS):
            _curves(axes, test, data[scene][test])
    for row, (xlabel, ylabel) in zip(panels, TESTS.values()):
        for axes in row:
            axes.set_xlabel(xlabel)
        row[0].set_ylabel(f"{ylabel} [kPa]")
    figure.align_ylabels(panels[:, 0])
    style.legend_above(figure, panels[0, 0], 4)
    return figure


def _curves(axes, test: str, values: Mapping) -> None:
    x = np.asarray(values["x"])
    low, high = values["visited"]
    if test == "yield":
        axes.axhspan(1e-3 * low, 1e-3 * high, color=VISITED, linewidth=0, label="visited in the video")
    else:
        axes.axvspan(low, high, color=VISITED, linewidth=0, label="visited in the video")
    for law, title in LAWS.items():
        kind = style.look(law)
        width = 2.4 if law == "truth" else 1.1
        color = style.GREY if law == "truth" else kind.color
        axes.plot(
            x,
            1e-3 * np.asarray(values["stress"][law]),
            color=color,
            linestyle=kind.dash,
            linewidth=width,
            label=title,
        )
    shown = 1e-3 * np.concatenate(list(values["stress"].values()))
    margin = 0.08 * (np.ptp(shown) or 1.0)
    axes.set(xlim=(x.min(), x.max()), ylim=(shown.min() - margin, shown.max() + margin))
    axes.axhline(0, color=style.GREY, linewidth=0.4, zorder=0.5)
    axes.set_xticks(_ticks(test, x))
    axes.xaxis.set_major_formatter("{x:g}")
    axes.yaxis.set_major_locator(MaxNLocator(4))


def _ticks(test: str, x: np.ndarray) -> list[float]:
    """Few and round: panels are narrow."""
    if test == "uniaxial":
        return [float(f"{1 + 0.6 * (x.min() - 1):.2g}"), 1.0]
    if test == "shear":
        end = float(f"{0.6 * x.max():.1g}")
        return [-end, 0.0, end]
    return [0.0, float(f"{0.5 * x.max():.2g}"), float(f"{x.max():.2g}")]
