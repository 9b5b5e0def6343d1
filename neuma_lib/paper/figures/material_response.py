"""Material point tests: responses of the laws without grid or body. Top: axial Kirchhoff stress of the elastic law over
axial stretch, with traction-free sides. Middle: shear stress of the elastic law in simple shear, compressed to the 5th
percentile of the observed volume ratios J. Bottom: the same shear at a constant rate of 20 per second, with elastic law
and return map in every step; the curve bends where the material yields or flows. Blue: range of elastic stretches,
shears and shear stresses of the true law on the reconstruction (99 % of them). Ranges are marginal, so not every
combination inside them occurs. Coloured bands: 95 % of the laws that the video allows, from the covariance of the
constants and, for corrections, a Gaussian process. Laws without a covariance have the range of their replicates. The
video determines elastic law and return map together, so each alone may differ from the truth. Curves far from the truth
are cut at the edge of the panel. Not in the paper.
"""

from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.figure import Figure

from neuma_lib.evaluation.bands import envelope
from neuma_lib.evaluation.plotting import style
from neuma_lib.evaluation.response import inside
from neuma_lib.evaluation.stress_curves import HEADROOM, draw_laws, draw_visited, set_limits
from neuma_lib.io.files import read_json

TESTS = {
    "uniaxial": ("axial stretch", "axial stress"),
    "shear": ("elastic shear", "shear stress"),
    "yield": ("total shear", "shear stress"),
}


def data(inputs, params, log) -> dict:
    """``titles`` of the laws, and ``scenes`` with the tests of `TESTS`.

    A test has ``x``, ``visited`` (low, high), ``by_stress``, ``true`` [Pa] and ``laws`` with ``stress`` [Pa] and
    ``band``: None, or ``x``, ``low``, ``high``, and ``inside``, the share of visited points with the truth in it.
    """
    files = iter(inputs.responses)
    scenes: dict = {}
    for scene, method, count in params.cells:
        replicates = [read_json(next(files)) for _ in range(count)]
        for test in TESTS:
            runs = [replicate[test] for replicate in replicates]
            shared = {key: runs[0][key] for key in ("x", "visited", "by_stress", "true")}
            entry = scenes.setdefault(scene, {}).setdefault(test, {**shared, "laws": {}})
            entry["laws"][method] = {"stress": runs[0]["stress"], "band": _band(runs)}
    content = {"titles": params.titles, "scenes": scenes}
    for method, parts in covered(content).items():
        whole = sum(part == 1 for values in parts.values() for part in values)
        total = sum(map(len, parts.values()))
        log(f"{params.titles[method]}: the truth is inside {whole} of {total} bands everywhere")
    return content


def covered(data: Mapping) -> dict[str, dict[str, list[float]]]:
    """Shares of visited points inside the band, {law: {scene: a value for each test}}, for laws with bands."""
    shares: dict[str, dict[str, list[float]]] = {}
    for scene, tests in data["scenes"].items():
        for test in tests.values():
            for method, law in test["laws"].items():
                if law["band"] and law["band"]["inside"] is not None:
                    shares.setdefault(method, {}).setdefault(scene, []).append(law["band"]["inside"])
    return shares


def _band(runs: Sequence[Mapping]) -> dict | None:
    """The band of all replicates of a law in a test, or of their curves for laws without bands."""
    if all("band" in run for run in runs):
        x, ends = runs[0]["band"]["x"], [(run["band"]["low"], run["band"]["high"]) for run in runs]
    elif len(runs) > 1:
        x, ends = runs[0]["x"], [(run["stress"], run["stress"]) for run in runs]
    else:
        return None
    low, high = envelope(ends)
    band = {"x": x, "low": low.tolist(), "high": high.tolist()}
    return {**band, "inside": inside({**runs[0], "band": band})}


@style.styled
def draw(data: Mapping) -> Figure:
    """A column for each scene and a row for each test."""
    scenes = data["scenes"]
    figure = style.new_figure(style.PAGE if len(scenes) > 2 else style.COLUMN, 0.35 + 1.25 * len(TESTS))
    panels = figure.subplots(len(TESTS), len(scenes), squeeze=False)
    for column, (scene, tests) in zip(panels.T, scenes.items()):
        column[0].set_title(scene)
        for axes, test in zip(column, TESTS):
            _curves(axes, test, tests[test], data["titles"])
    for row, (xlabel, ylabel) in zip(panels, TESTS.values()):
        for axes in row:
            axes.set_xlabel(xlabel)
        row[0].set_ylabel(f"{ylabel} [kPa]")
    figure.align_ylabels(panels[:, 0])
    style.legend_above(figure, panels[0, 0], 6 if len(scenes) > 2 else 2)
    return figure


def _curves(axes, test: str, values: Mapping, titles: Mapping[str, str]) -> None:
    x, true = np.asarray(values["x"]), 1e-3 * np.asarray(values["true"])
    draw_visited(axes, values["visited"], values["by_stress"], label="visited in the video")
    axes.plot(x, true, color=style.GREY, linewidth=2.4, label="true law")
    draw_laws(axes, values, titles)
    curves = [true, *(1e-3 * np.asarray(law["stress"]) for law in values["laws"].values())]
    room = HEADROOM * (np.ptp(true) or 1.0)
    set_limits(axes, x, max(np.min(curves), true.min() - room), min(np.max(curves), true.max() + room))
    axes.set_xticks(_ticks(test, x))
    axes.xaxis.set_major_formatter("{x:g}")


def _ticks(test: str, x: np.ndarray) -> list[float]:
    """Few round ticks, because panels are narrow."""
    if test == "uniaxial":
        return [float(f"{1 + 0.6 * (x.min() - 1):.2g}"), 1.0]
    if test == "shear":
        end = float(f"{0.6 * x.max():.1g}")
        return [-end, 0.0, end] if len(f"{end:g}") <= 4 else [-end, end]
    return [0.0, float(f"{0.5 * x.max():.2g}"), float(f"{x.max():.2g}")]
