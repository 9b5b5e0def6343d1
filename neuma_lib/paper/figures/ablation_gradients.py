"""Alternatives that the paper leaves open, on three scenes: image gradients through means and covariances (NeuMA) or
through means only (as in the authors' released code); gradients zeroed before every iteration or accumulated (as in the
released loop); covariances stretched by the elastic deformation (paper) or by the total one, plastic flow included. Not
in the paper.
"""

from collections.abc import Mapping
from operator import itemgetter

import numpy as np
from matplotlib.figure import Figure

from neuma_lib.evaluation.plotting import style
from neuma_lib.paper.results import read_results, seen_in_training

MEASURES = {
    "tracer_rmse_mm": "tracer RMSE [mm]",
    "chamfer": "Chamfer distance\n[10⁻⁴ m²]",
    "psnr": "PSNR, views not seen\nin training [dB]",
    "loss": "best training loss\nrelative to the prior's",
}
MARKERS = "osDv^P"


def data(inputs, params, log) -> dict:
    """``scenes`` in order, ``titles`` {variant: name} and for each of `MEASURES` {variant: {scene: value}}.

    ``seen``: scenes without other views than those of the training.
    """
    values = {
        "tracer_rmse_mm": (inputs.metrics, itemgetter("tracer_rmse_mm")),
        "chamfer": (inputs.metrics, itemgetter("chamfer")),
        "psnr": (inputs.image_metrics, itemgetter("psnr")),
        "loss": (inputs.histories, lambda history: history["best_loss"] / history["loss"][0]),
    }
    cells = params.titles, params.scenes
    measures = {name: read_results(files, *cells, value) for name, (files, value) in values.items()}
    seen = seen_in_training(read_results(inputs.image_metrics, *cells), params.scenes)
    log(f"{len(params.titles)} variants on {len(params.scenes)} scenes")
    return {"scenes": params.scenes, "titles": params.titles, "seen": seen, **measures}


@style.styled
def draw(data: Mapping) -> Figure:
    """A panel for each measure, with a point for each variant and scene."""
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
        labels = style.scene_labels(scenes, data["seen"]) if measure == "psnr" else scenes
        axes.set_xticks(range(len(scenes)), labels, rotation=30, ha="right")
        if measure != "psnr":
            axes.set_ylim(bottom=0)
        axes.grid(axis="y")
        style.separate(axes, len(scenes))
    style.legend_above(figure, panels[0], len(titles))
    return figure
