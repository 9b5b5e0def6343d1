"""Choices in the gradient and in the covariances that the paper leaves open, on three scenes (not in the paper)."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from matplotlib.figure import Figure

from neuma_lib.evaluation.figures import style

MEASURES = {
    "loss": "best training loss\nrelative to the prior's",
    "chamfer_excess": "excess Chamfer distance\n[10⁻⁴ m²]",
    "tracer_rmse_mm": "tracer RMSE [mm]",
    "psnr": "PSNR, views not seen\nin training [dB]",
}
MARKERS = "osDv^P"


@style.styled
def draw(data: Mapping) -> Figure:
    """Draw one panel a measure; every variant has a point in every scene.

    Args:
        data: ``scenes`` in order, ``titles`` {variant: name} and for each of `MEASURES` {variant: {scene: value}}.
    """
    scenes, titles = data["scenes"], data["titles"]
    figure = style.new_figure(style.PAGE, 2.1)
    panels = figure.subplots(1, len(MEASURES))
    offsets = np.linspace(-0.3, 0.3, len(titles)) if len(titles) > 1 else [0.0]
    for axes, (measure, label) in zip(panels, MEASURES.items()):
        for k, (offset, (variant, title)) in enumerate(zip(offsets, titles.items())):
            axes.plot(
                np.arange(len(scenes)) + offset,
                [data[measure][variant][scene] for scene in scenes],
                MARKERS[k % len(MARKERS)],
                color=style.SEQUENCE[k % len(style.SEQUENCE)],
                label=title,
                clip_on=False,
            )
        axes.set(title=label, xlim=(-0.5, len(scenes) - 0.5))
        axes.set_xticks(range(len(scenes)), scenes, rotation=30, ha="right")
        if measure != "psnr":
            axes.set_ylim(bottom=0)
        axes.grid(axis="y")
        for edge in range(len(scenes) - 1):
            axes.axvline(edge + 0.5, color=style.LIGHT, linewidth=0.5)
    style.legend_above(figure, panels[0], len(titles))
    return figure
