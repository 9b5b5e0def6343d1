"""Gradient norms through training, and how far both networks moved."""

from statistics import median

import torch

from neuma_lib.io.files import read_json, write_json
from neuma_lib.io.laws import load_law
from workflow.stage import stage


def relative_change(part) -> float:
    """||W - W0|| / ||W0|| of a network with an adaptor, over all layers."""
    base = torch.cat([w.flatten() for w in part.base])
    return float((torch.cat([w.detach().flatten() for w in part.weights()]) - base).norm() / base.norm())


def main(inputs, data_file: str, params, run) -> None:
    data = {}
    for k, (scene, wrong) in enumerate(params.scenes.items()):
        history = read_json(inputs.history[k])
        law = load_law(inputs.prior[k], inputs.adaptor[k])
        data[scene] = {
            "norms": {name: history[f"gradient_norm_{name}"] for name in ("elastic", "plastic")},
            "change": {
                "elastic": relative_change(law.elasticity),
                "plastic": relative_change(law.plasticity),
            },
            "wrong": wrong,
        }
        middle = {name: median(norms) for name, norms in data[scene]["norms"].items()}
        run.say(
            f"{scene}: median gradient norm {middle['elastic']:.2f} elastic, {middle['plastic']:.2f} plastic;"
            " weights moved "
            + " and ".join(f"{100 * change:.1f} %" for change in data[scene]["change"].values())
        )
    write_json(data_file, data)


if __name__ == "__main__":
    with stage("gradient_analysis_data", snakemake.log[0]) as run:
        main(snakemake.input, snakemake.output.data, snakemake.params, run)
