"""A page that shows a law in three tests of a material point."""

from collections.abc import Mapping
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from neuma_lib.config.figures import FiguresConfig
from neuma_lib.errors import InputError
from neuma_lib.evaluation.material_point import Visited
from neuma_lib.evaluation.plotting import style
from neuma_lib.evaluation.response import tests_within
from neuma_lib.evaluation.stress_curves import draw_visited
from neuma_lib.io.files import one_line
from neuma_lib.mechanics.law import Law

TESTS = {
    "uniaxial": ("axial stretch, sides free", "axial stress"),
    "shear": ("elastic shear", "shear stress"),
    "yield": ("total shear at {rate:g}/s", "shear stress"),
}
UNSEEN = Visited(stretch=(0.8, 1.2), shear=(-0.3, 0.3), pressed=1.0)
"""Range of the tests of a law without known states."""


@style.styled
def law_page(law: Law, about: Mapping[str, Any]) -> Figure:
    """Draw uniaxial stretch, elastic shear, and shear at a constant rate with the return map.

    A blue background marks the range that the law was exposed to in its scene.
    """
    seen, largest = _ranges(about)
    settings, dt = FiguresConfig(), about.get("dt") or 1e-3
    tests = tests_within(seen, largest or 0.0, settings.shear_rate, settings.total_shear, dt)
    figure = style.new_figure(style.PAGE, 0.3 * style.PAGE)
    for axes, (name, (xlabel, ylabel)) in zip(figure.subplots(1, len(TESTS)), TESTS.items(), strict=True):
        test = tests[name]
        if largest is not None:
            draw_visited(axes, test.visited, test.by_stress, zorder=0)
        axes.plot(test.x, 1e-3 * test.curve(law, test.x), color=style.BLUE)
        axes.axhline(0, color=style.GREY, linewidth=0.4, zorder=0.5)
        axes.set(xlabel=xlabel.format(rate=settings.shear_rate), ylabel=f"{ylabel} [kPa]")
    where = " / ".join(one_line(about[key], 60) for key in ("scene", "method") if about.get(key)) or law.name
    step = f", learned at dt = {dt:g} s" if about.get("dt") else ""
    figure.suptitle(f"{where}: {one_line(about.get('kind'), 20)}{step}".replace("$", r"\$"))
    return figure


def _ranges(about: Mapping[str, Any]) -> tuple[Visited, float | None]:
    """Visited ranges and largest shear stress [Pa]. `UNSEEN` and None if they are unknown."""
    visited = about.get("visited")
    if visited is None:
        return UNSEEN, None
    try:
        pairs = {key: tuple(map(float, visited[key])) for key in ("stretch", "shear")}
        if not all(len(pair) == 2 and np.isfinite(pair).all() for pair in pairs.values()):
            raise ValueError
        return Visited(**pairs, pressed=float(visited["pressed"])), float(visited["shear_stress"])
    except (KeyError, TypeError, ValueError):
        problem = f"{one_line(visited)} is not a range that `neuma law export` writes"
        raise InputError("visited in the law's metadata", problem, "Export the law again") from None
