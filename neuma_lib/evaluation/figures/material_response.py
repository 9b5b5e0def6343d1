"""Tests of single material points: what the laws themselves say, without grid or body. Top: axial Kirchhoff stress of
the elastic law over the axial stretch, the sides free of traction. Middle: shear stress of the elastic law over simple
shear, compressed to the 5th percentile of the observed volume ratios J. Bottom: the same shear at a constant rate of 20
per second with elastic law and return map step by step, as in the simulation: where the curve bends, the material
yields or flows. Blue: the range of elastic stretches, shears and shear stresses that the true motion of the video went
through (99 % of them). Ranges are marginal: not every combination inside them was visited. The video determines motion,
that is elastic law and return map together; where the two can trade places, each alone may differ from the truth. Not
in the paper.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial

import numpy as np
import torch
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from neuma_lib.evaluation.material_point import Visited, largest_shear_stress, sheared, uniaxial, yielding
from neuma_lib.evaluation.plotting import style
from neuma_lib.io.hdf5 import read_arrays
from neuma_lib.io.laws import load_law
from neuma_lib.mechanics.analytic import analytic_law

LAWS = {"truth": "true law", "nclaw": "prior", "neuma": "NeuMA"}
TESTS = {
    "uniaxial": ("axial stretch", "axial stress"),
    "shear": ("elastic shear", "shear stress"),
    "yield": ("total shear", "shear stress"),
}
VISITED = "#d9e6ef"
"""Colour of the visited ranges."""
BEYOND = 1.6
"""How far the tests go beyond the visited range, relative to its distance from the undeformed state."""
SMALLEST_STRETCH = 0.05
POINTS = 121
"""Points of a curve."""
STATES = 300_000
"""About the most states of the motion that are looked at."""


def data(inputs, params, say) -> dict:
    """Of every scene the tests of `TESTS`: ``x``, ``stress`` [Pa] {law: values} and ``visited`` (low, high).

    The last is a range of x, for the test of yielding of the stress.
    """
    found = {}
    for k, (scene, setting) in enumerate(params.scenes.items()):
        truth, _ = read_arrays(inputs.truth[k], required=("F",), only=("F",))
        F = torch.from_numpy(truth["F"]).reshape(-1, 3, 3)
        F = F[:: max(1, len(F) // STATES)]
        dt = setting["dt"]
        laws = {
            "truth": analytic_law(setting["law"], dt=dt),
            "nclaw": load_law(inputs.prior[k]),
            "neuma": load_law(inputs.prior[k], inputs.adaptor[k]),
        }
        seen = Visited.of(F)
        low, high = (1 + BEYOND * (end - 1) for end in seen.stretch)
        stretch, shear = _axis(max(low, SMALLEST_STRETCH), high), _axis(*(BEYOND * s for s in seen.shear))
        steps = round(params.total_shear / (params.rate * dt))
        total = params.rate * dt * torch.arange(steps + 1, dtype=torch.float64)
        yielded = partial(yielding, rate=params.rate, dt=dt, steps=steps, J=seen.pressed)
        tests = {
            "uniaxial": (stretch, partial(uniaxial, stretch=stretch), seen.stretch),
            "shear": (shear, partial(sheared, shear=shear, J=seen.pressed), seen.shear),
            "yield": (total, yielded, (0.0, largest_shear_stress(laws["truth"], F))),
        }
        found[scene] = {
            test: {
                "x": x.tolist(),
                "stress": {name: stress(law).tolist() for name, law in laws.items()},
                "visited": visited,
            }
            for test, (x, stress, visited) in tests.items()
        }
        low, high = seen.stretch
        say(f"{scene}: stretches {low:.2f} to {high:.2f}, 5th percentile of J {seen.pressed:.3f}")
    return found


def _axis(low: float, high: float) -> torch.Tensor:
    return torch.linspace(low, high, POINTS, dtype=torch.float64)


@style.styled
def draw(data: Mapping) -> Figure:
    """A column a scene and a row a test."""
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
    span = axes.axhspan if test == "yield" else axes.axvspan
    scale = 1e-3 if test == "yield" else 1.0
    span(scale * low, scale * high, color=VISITED, linewidth=0, label="visited in the video")
    for law, title in LAWS.items():
        line = style.look(law).line | ({"color": style.GREY, "linewidth": 2.4} if law == "truth" else {})
        axes.plot(x, 1e-3 * np.asarray(values["stress"][law]), **line, label=title)
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
        return [-end, 0.0, end] if len(f"{end:g}") <= 4 else [-end, end]
    return [0.0, float(f"{0.5 * x.max():.2g}"), float(f"{x.max():.2g}")]
