"""Which law does training change? Norms of the loss gradient with respect to the adaptors of the elastic and of the
plastic network over the iterations, their medians, and how far the merged weights moved from those of the prior. The
titles name the laws of the prior that are wrong. Paper: fig:gradient_analysis.
"""

from collections.abc import Mapping
from statistics import median

import numpy as np
import torch
from matplotlib.figure import Figure

from neuma_lib.evaluation.plotting import style
from neuma_lib.io.files import read_json
from neuma_lib.io.laws import load_law

NETWORKS = {"elastic": (style.BLUE, "-"), "plastic": (style.VERMILION, (0, (4, 1.5)))}


def data(inputs, params, log) -> dict:
    """For each scene ``norms`` {network: a value per iteration} and ``change`` {network: ||W - W0|| / ||W0||}.

    ``wrong`` names the laws of the prior that differ from the truth.
    """
    scenes = {}
    for k, (scene, wrong) in enumerate(params.scenes.items()):
        history = read_json(inputs.history[k])
        law = load_law(inputs.prior[k], inputs.adaptor[k])
        norms = {name: history[f"gradient_norm_{name}"] for name in NETWORKS}
        change = {"elastic": _relative_change(law.elasticity), "plastic": _relative_change(law.plasticity)}
        scenes[scene] = {"norms": norms, "change": change, "wrong": wrong}
        middle = ", ".join(f"{median(values):.2f} {name}" for name, values in norms.items())
        moved = " and ".join(f"{100 * c:.1f} %" for c in change.values())
        log(f"{scene}: median gradient norm {middle}; weights moved {moved}")
    return scenes


def _relative_change(part) -> float:
    """||W - W0|| / ||W0|| of a network with an adaptor, over all layers."""
    base = torch.cat([w.flatten() for w in part.base])
    return float((torch.cat([w.detach().flatten() for w in part.weights()]) - base).norm() / base.norm())


@style.styled
def draw(data: Mapping) -> Figure:
    """Gradient norms over iterations, their medians, and the relative change of the weights.

    Medians are insensitive to single unstable iterations.
    """
    scenes = list(data)
    figure = style.new_figure(style.PAGE, 1.8)
    panels = figure.subplots(1, len(scenes) + 2, width_ratios=[1.6] * len(scenes) + [1, 1])
    for axes, scene in zip(panels, scenes):
        for network, (color, dash) in NETWORKS.items():
            norms = data[scene]["norms"][network]
            iterations = range(1, len(norms) + 1)
            axes.plot(iterations, norms, color=color, linestyle=dash, label=f"{network} network")
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
        axes.set_xticks(place, [_on_two_lines(scene) for scene in scenes])
        axes.grid(axis="y")
    style.legend_above(figure, panels[0], 2)
    return figure


def _on_two_lines(name: str) -> str:
    """A name such as BouncyBall with a line break before its second capital."""
    return "".join("\n" + c if c.isupper() and i else c for i, c in enumerate(name))
