"""A page on the material identified in a video: losses of all families, and constants of the best one."""

from collections.abc import Mapping
from typing import Any

from matplotlib.figure import Figure
from matplotlib.ticker import NullFormatter

from neuma_lib.evaluation.calibration import describe_families, interval, kind_of
from neuma_lib.evaluation.plotting import style
from neuma_lib.paper.identified_table import true_values

_RATIOS = (0.01, 0.1, 0.3, 0.5, 0.7, 1, 1.5, 2, 3, 10, 100)  # ticks
_WIDEST = 1.5  # maximum length of an error bar to either side, in decades


@style.styled
def identified_page(identified: Mapping[str, Any], truth: Mapping[str, Mapping[str, Any]] | None) -> Figure:
    """Draw the held-out loss of each evaluated family, and the best one's constants relative to their values.

    They are those of the material, or of the grid if there is no second one.

    Error bars are calibrated 95 % intervals, crosses are the truth. The title has the probabilities of families.

    Args:
        identified: content of identified.json.
        truth: specification of the true law. None if unknown.
    """
    figure = style.new_figure(style.PAGE, 0.6 * style.COLUMN)
    losses, constants = figure.subplots(1, 2)
    scored = {name: fit for name, fit in identified["families"].items() if "held_out_loss" in fit}
    order = sorted(scored, key=lambda name: scored[name]["score"], reverse=True)
    as_good = {identified["family"]: style.BLACK} | dict.fromkeys(identified["ties"], style.GREY)
    for place, name in enumerate(order):
        loss = scored[name]["held_out_loss"]
        losses.plot([loss], [place], "o", color=as_good.get(name, style.SKY))
        losses.annotate(f"{loss:.1e}", (loss, place), (0, 4), textcoords="offset points", ha="center")
    losses.margins(0.15)
    losses.set_yticks(range(len(order)), order)
    dropped = [name for name in identified["families"] if name not in scored]
    title = f"pruned: {', '.join(dropped)}" if dropped else "all families"
    losses.set(xscale="log", xlabel="mean squared residual of held-out frames", title=title)
    losses.xaxis.set_minor_formatter(NullFormatter())

    quantities = identified.get("material", identified["best"])["quantities"]
    true = true_values(truth or {})
    for place, (name, entry) in enumerate(reversed(quantities.items())):
        _, high = interval(1.0, entry["log_std"], quantity=kind_of(identified))
        factor = min(high, 10**_WIDEST)
        reach = [[1 - 1 / factor], [factor - 1]]
        colour = style.BLACK if entry["determined"] else style.GREY
        constants.errorbar([1], [place], xerr=reach, fmt="o", color=colour, capsize=2)
        if name in true and true[name] > 0 and entry["value"] > 0:
            constants.plot([true[name] / entry["value"]], [place], "x", color=style.SEQUENCE[0], zorder=3)
    names = [f"{name} = {entry['value']:.3g}" for name, entry in quantities.items()]
    constants.set_yticks(range(len(names)), names[::-1])
    constants.set(
        xscale="log", xlabel="relative to the identified value\n(cross: truth, grey: not determined)"
    )
    low, high = constants.get_xlim()
    ticks = [tick for tick in _RATIOS if low < tick < high]
    constants.set_xticks(ticks, [f"{tick:g}" for tick in ticks], minor=False)
    constants.xaxis.set_minor_formatter(NullFormatter())
    constants.axvline(1, color=style.LIGHT, zorder=0)
    lowest = identified.get("contact_friction", {}).get("at_least")
    friction = "" if lowest is None else f", contact_friction at least {lowest:.2g}"
    constants.set_title((describe_families(identified) or identified["family"]) + friction)
    return figure
