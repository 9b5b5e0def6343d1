"""Released bodies: records of markers next to the motion of the fitted law, and silhouettes that are predicted."""

from collections.abc import Mapping
from typing import Any

import numpy as np
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


@styled
def swing_figure(result: Mapping[str, Any]) -> Figure:
    """Predicted silhouettes of a released body on the finest grid, and their distances from the observed ones.

    Args:
        result: of `fitting.swing.swing_record`.
    """
    figure = new_figure(PAGE, 2.4)
    pictures, distances = figure.subplots(1, 2, width_ratios=(3, 2))
    clamps, times = result["clamps"], [1e3 * time for time in result["times"]]
    best = min(clamps.values(), key=lambda own: own["grids"][-1]["predicted"]["contour_rms"])
    for lines, time, colour in zip(best["silhouettes"], times, SEQUENCE, strict=False):
        outer = np.array(max(lines, key=len))
        pictures.plot(*outer.T, color=colour, linewidth=0.8, label=f"{time:.0f} ms")
    pictures.set_aspect("equal")
    pictures.invert_yaxis()
    pictures.set_xlabel("predicted outline [px]")
    pictures.legend(loc="lower right", frameon=False)
    for (name, own), colour in zip(clamps.items(), SEQUENCE, strict=False):
        for key, dash in (("predicted", "-"), ("fitted", ":")):
            values = own["grids"][-1][key]["contour_rms_by_frame"]
            label = f"clamp {name}, {key}"
            distances.plot(times, values, "o", linestyle=dash, color=colour, markersize=2.5, label=label)
    distances.set_ylim(0)
    distances.set_xlabel("time [ms]")
    distances.set_ylabel("distance of the contour, rms [px]")
    distances.legend(frameon=False)
    return figure
