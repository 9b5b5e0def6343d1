"""Records of markers on a released beam, next to the motion of the fitted law."""

from __future__ import annotations

from matplotlib.figure import Figure

from neuma_lib.evaluation.plotting.style import GREY, PAGE, SEQUENCE, new_figure, styled
from neuma_lib.fitting.specimen_fit import SpecimenFit


@styled
def specimen_figure(fit: SpecimenFit) -> Figure:
    """Heights of the markers over time, measured as points and simulated as lines, and their difference below."""
    figure = new_figure(PAGE, 1.45 * len(fit.records) + 0.3)
    grid = figure.subplots(len(fit.records), 2, sharex=True, squeeze=False, width_ratios=(2, 1))
    for (motion, difference), record in zip(grid, fit.records, strict=True):
        start = record.observed[0]
        for m, colour in zip(range(record.observed.shape[1]), SEQUENCE, strict=False):
            observed, simulated = (
                1e3 * (own[:, m] - start[m]) for own in (record.observed, record.simulated)
            )
            motion.plot(record.times, observed, ".", color=colour, markersize=2, label=f"marker {m + 1}")
            motion.plot(record.times, simulated, color=colour, linewidth=0.7)
            difference.plot(record.times, simulated - observed, color=colour, linewidth=0.7)
        motion.set_ylabel("height [mm]")
        motion.set_title(record.name, loc="left")
        difference.axhline(0.0, color=GREY, linewidth=0.5)
        difference.set_title("simulated \N{MINUS SIGN} measured [mm]", loc="left")
    grid[0, 0].legend(ncols=3, loc="upper right", frameon=False)
    for axes in grid[-1]:
        axes.set_xlabel("time after the release [s]")
    return figure
