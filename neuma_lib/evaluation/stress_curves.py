"""Stress curves of laws that were learned for one object, over the states of its motion, without ground truth.

Simulated lengths are ``scale`` times those of the room. Times and densities are equal, so a stress in the room is the
simulated one divided by the square of the scale.
"""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator
from torch import Tensor

from neuma_lib.evaluation.plotting import style
from neuma_lib.evaluation.response import band_of_test, inside, material_tests
from neuma_lib.mechanics.law import Law

TESTS = {
    "uniaxial": ("axial stretch", "axial stress"),
    "shear": ("elastic shear", "shear stress"),
    "yield": ("total shear, {rate:g} per second", "shear stress"),
}
"""Axes of the panels, from top to bottom."""
VISITED = "#d9e6ef"
"""Colour of the visited ranges."""
HEADROOM = 0.6  # limit of the curve of a law without error bars beyond the others, relative to their range


def stress_curves(
    laws: Mapping[str, Law],
    learned: str,
    F: Tensor,
    rate: float,
    total_shear: float,
    dt: float,
    draws: Mapping[str, Sequence[Law]],
    scale: float = 1.0,
) -> dict[str, Any]:
    """Curves of laws in tests of a material point, in the room's units, as plain numbers.

    Args:
        laws: by method.
        learned: the method whose motion is F, and whose stress gives the visited range of the last test.
        F: its elastic deformation gradients (..., 3, 3).
        rate, total_shear: of the last test, see `material_tests` [1/s] and 1.
        dt: time step [s].
        draws: sampled laws by method, for methods with an estimate of uncertainty.
        scale: simulated metres per metre of the room.

    Returns:
        ``rate``, ``learned`` and ``tests``: for each ``x``, ``visited`` (low, high), ``by_stress`` and ``laws`` with
        ``stress`` [Pa] and ``band``, which is None, or ``x``, ``low`` and ``high`` [Pa].
    """
    per = 1 / scale**2
    tests: dict[str, Any] = {}
    for name, test in material_tests(laws[learned], F, rate, total_shear, dt).items():
        curves = {
            method: {
                "stress": (per * test.curve(law, test.x)).tolist(),
                "band": band_of_test(test, draws[method], per) if draws.get(method) else None,
            }
            for method, law in laws.items()
        }
        visited = [per * end for end in test.visited] if test.by_stress else list(test.visited)
        shared = {"x": test.x.tolist(), "visited": visited, "by_stress": test.by_stress}
        tests[name] = {**shared, "laws": curves}
    return {"rate": rate, "learned": learned, "tests": tests}


def share_inside(test: Mapping[str, Any], method: str, band_of: str) -> float | None:
    """Share of the visited range of a test at which a law lies in the band of another.

    None without a band or visited points.
    """
    limits = test["laws"].get(band_of, {}).get("band")
    if not limits:
        return None
    return inside({**test, "band": limits, "true": test["laws"][method]["stress"]})


@style.styled
def draw(curves: Mapping[str, Mapping[str, Any]], titles: Mapping[str, str]) -> Figure:
    """Draw a panel for each test: below each other for one body, else in a row for each body.

    Args:
        curves: result of `stress_curves` by body. The only body has an empty name.
        titles: method -> name.
    """
    rows, columns = (len(curves), len(TESTS)) if len(curves) > 1 else (len(TESTS), 1)
    figure = style.new_figure(style.COLUMN * columns, 0.4 + 1.5 * rows)
    panels = figure.subplots(rows, columns, squeeze=False)
    for row, (body, own) in zip(panels.reshape(len(curves), -1), curves.items(), strict=True):
        row[0].set_title(body)
        for axes, (name, (xlabel, ylabel)) in zip(row, TESTS.items(), strict=True):
            _panel(axes, own["tests"][name], titles, own["learned"])
            axes.set(xlabel=xlabel.format(rate=own["rate"]), ylabel=f"{ylabel} [kPa]")
    figure.align_ylabels(panels)
    style.legend_above(figure, panels[0, 0], 2)
    return figure


def _panel(axes, test: Mapping[str, Any], titles: Mapping[str, str], learned: str) -> None:
    draw_visited(axes, test["visited"], test["by_stress"], label="seen in the video")
    draw_laws(axes, test, titles, thick=learned)
    set_limits(axes, test["x"], *_limits(test, learned))
    axes.xaxis.set_major_locator(MaxNLocator(4))  # small ranges have long labels


def draw_visited(axes, visited: Sequence[float], by_stress: bool, **options) -> None:
    """Mark the visited range of a test, in stresses [Pa] or in prescribed values."""
    span, unit = (axes.axhspan, 1e-3) if by_stress else (axes.axvspan, 1.0)
    span(*(unit * end for end in visited), color=VISITED, linewidth=0, **options)


def draw_laws(axes, test: Mapping[str, Any], titles: Mapping[str, str], thick: str | None = None) -> None:
    """Draw the curves of all laws [kPa] with their bands."""
    for method, law in test["laws"].items():
        line = style.look(method).line
        if law["band"]:
            ends = [1e-3 * np.asarray(law["band"][end]) for end in ("low", "high")]
            axes.fill_between(law["band"]["x"], *ends, color=line["color"], alpha=0.18, linewidth=0)
        width = 1.8 if method == thick else 1.1
        stress = 1e-3 * np.asarray(law["stress"])
        axes.plot(test["x"], stress, **line, linewidth=width, label=titles[method])


def set_limits(axes, x: Sequence[float], low: float, high: float) -> None:
    """Limit a panel to the range of x and, with a margin, to stresses [kPa]."""
    margin = 0.08 * (high - low or 1.0)
    axes.set(xlim=(min(x), max(x)), ylim=(low - margin, high + margin))
    axes.axhline(0, color=style.GREY, linewidth=0.4, zorder=0.5)
    axes.yaxis.set_major_locator(MaxNLocator(4))


def _limits(test: Mapping[str, Any], learned: str) -> tuple[float, float]:
    """Lowest and highest stress [kPa] of a panel: all laws in the visited range, within `HEADROOM`."""
    x, (first, last) = np.asarray(test["x"]), test["visited"]
    seen = np.ones(len(x), bool) if test["by_stress"] else (x >= first) & (x <= last)
    laws = {method: 1e-3 * np.asarray(law["stress"])[seen] for method, law in test["laws"].items()}
    # laws with error bars are always compared with the learned law
    kept = np.concatenate([v for m, v in laws.items() if m == learned or test["laws"][m]["band"]])
    whole, room = np.concatenate(list(laws.values())), HEADROOM * (np.ptp(kept) or 1.0)
    return max(whole.min(), kept.min() - room), min(whole.max(), kept.max() + room)
