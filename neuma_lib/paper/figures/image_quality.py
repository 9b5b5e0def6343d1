"""Quality of renders against the observation: PSNR, SSIM (higher is better) and LPIPS with the VGG and Alex networks
(lower is better), averaged over all frames, on the bounding box of the object plus a margin, in views not used for
training. Labels mark scenes without such a view, and methods that train on all views. Grey column: mean over the
scenes. NCLaw is the prior rendered by Particle-GS (the paper's NCLaw+R). PAC-NeRF on its own particles is rendered as
its radiance field. Paper: fig:image_quality.
"""

from collections.abc import Mapping
from operator import itemgetter

import numpy as np
from matplotlib.figure import Figure

from neuma_lib.evaluation.plotting import style
from neuma_lib.paper.results import read_results, seen_everywhere, seen_in_training

MEASURES = {
    "psnr": "PSNR [dB] ↑",
    "ssim": "SSIM ↑",
    "lpips_vgg": "LPIPS (VGG) ↓",
    "lpips_alex": "LPIPS (Alex) ↓",
}
SPREAD = 0.62  # share of a scene's slot that the methods fill side by side
LEGEND_COLUMNS = 5  # maximum number of names in a row of the legend


def data(inputs, params, log) -> dict:
    """``titles`` {method: name}, ``scenes`` in order, and a {method: {scene: value}} for each of `MEASURES`.

    ``seen``: scenes without other views than those of the training.
    """
    cells = inputs.metrics, params.titles, params.scenes
    values = {measure: read_results(*cells, itemgetter(measure)) for measure in MEASURES}
    metrics = read_results(*cells)
    everywhere = seen_everywhere(metrics, params.scenes)
    seen = seen_in_training({m: row for m, row in metrics.items() if m not in everywhere}, params.scenes)
    titles = {
        m: f"{title} (training views)" if m in everywhere else title for m, title in params.titles.items()
    }
    log(f"{len(titles)} methods on {len(params.scenes)} scenes")
    return {"titles": titles, "scenes": params.scenes, "seen": seen, **values}


@style.styled
def draw(data: Mapping) -> Figure:
    """A row for each measure, with a point for each method and scene, and one for the mean over scenes."""
    scenes, titles = list(data["scenes"]), data["titles"]
    figure = style.new_figure(style.PAGE, 0.4 + 1.15 * len(MEASURES))
    panels = figure.subplots(len(MEASURES), 1, sharex=True)
    offsets = np.linspace(-SPREAD / 2, SPREAD / 2, len(titles)) if len(titles) > 1 else [0.0]
    for axes, (measure, label) in zip(panels, MEASURES.items()):
        for offset, (method, title) in zip(offsets, titles.items()):
            values = [data[measure][method][scene] for scene in scenes]
            values.append(float(np.mean(values)))
            kind = style.look(method)
            axes.plot(np.arange(len(values)) + offset, values, kind.marker, color=kind.color, label=title)
        axes.axvspan(len(scenes) - 0.5, len(scenes) + 0.5, color=style.LIGHT, alpha=0.6, linewidth=0)
        axes.set(ylabel=label, xlim=(-0.5, len(scenes) + 0.5))
        axes.grid(axis="y")
        style.separate(axes, len(scenes))
    panels[-1].set_xticks(range(len(scenes) + 1), [*style.scene_labels(scenes, data["seen"]), "average"])
    figure.align_ylabels(panels)
    rows = -(-len(titles) // LEGEND_COLUMNS)
    style.legend_above(figure, panels[0], -(-len(titles) // rows))
    return figure
