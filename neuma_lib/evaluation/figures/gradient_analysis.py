"""Which law the adaptor changes: gradients and corrections of both networks (paper, fig:gradient_analysis)."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from matplotlib.figure import Figure

from neuma_lib.evaluation.figures import style

NETWORKS = {"elastic": (style.BLUE, "-"), "plastic": (style.VERMILION, (0, (4, 1.5)))}


@style.styled
def draw(data: Mapping) -> Figure:
    """Draw gradient norms over iterations, their medians, and the relative change of the weights.

    Medians, because one unstable iteration would rule a mean.

    Args:
        data: scene -> {``norms`` {network: values an iteration}, ``change`` {network: ||W - W0|| / ||W0||},
            ``wrong``: the laws that differ from the truth, as text}.
    """
    scenes = list(data)
    figure = style.new_figure(style.PAGE, 1.8)
    panels = figure.subplots(1, len(scenes) + 2, width_ratios=[1.6] * len(scenes) + [1, 1])
    for axes, scene in zip(panels, scenes):
        for network, (color, dash) in NETWORKS.items():
            norms = data[scene]["norms"][network]
            axes.plot(
                range(1, len(norms) + 1), norms, color=color, linestyle=dash, label=f"{network} network"
            )
        axes.set(yscale="log", title=f"{scene}\n(wrong prior: {data[scene]['wrong']})", xlabel="iteration")
        axes.set_xlim(1, len(norms))
        axes.grid(axis="y")
    panels[0].set_ylabel("gradient norm")
    place = np.arange(len(scenes))
    for axes, title, value in (
        (panels[-2], "median gradient\nnorm", lambda s, n: float(np.median(data[s]["norms"][n]))),
        (panels[-1], "relative change\nof the weights", lambda s, n: data[s]["change"][n]),
    ):
        for offset, (network, (color, _)) in zip((-0.2, 0.2), NETWORKS.items()):
            axes.bar(place + offset, [value(s, network) for s in scenes], 0.38, color=color)
        axes.set_title(title)
        axes.set_xticks(place, [_broken(scene) for scene in scenes])
        axes.grid(axis="y")
    style.legend_above(figure, panels[0], 2)
    return figure


def _broken(name: str) -> str:
    """A name such as BouncyBall on two lines."""
    return "".join("\n" + c if c.isupper() and i else c for i, c in enumerate(name))
