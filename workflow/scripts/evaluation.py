"""Roll the learned law out from the estimated start and compare it with the ground truth."""

import numpy as np
import torch

from neuma_lib.artifacts import load_body, load_law
from neuma_lib.device import choose_device
from neuma_lib.evaluation.evaluate import evaluate
from neuma_lib.geometry.volume import sample_tracers
from neuma_lib.io import read_arrays, read_json, read_mesh, read_weights, write_arrays, write_json
from neuma_lib.progress import stage
from neuma_lib.sim import MPMModel


def main(inputs, output, params, run) -> None:
    device = choose_device(params.device)
    truth, _ = read_arrays(
        inputs.truth, only=("tracers", "tracers_again"), required=("tracers", "tracers_again")
    )
    tracers = sample_tracers(read_mesh(inputs.mesh), params.tracers, seed=params.seed)
    velocity = read_json(inputs.velocity)
    evaluation = evaluate(
        MPMModel(**params.simulation),
        load_law(inputs.prior, inputs.get("adaptor") or None).to(device),
        load_body(inputs.binding, inputs.gaussians, params.density).to(torch.float32, device),
        torch.tensor(velocity["v0"], dtype=torch.float32, device=device),
        params.frames,
        torch.from_numpy(truth["tracers"]).to(device),
        torch.from_numpy(truth["tracers_again"]).to(device),
        torch.as_tensor(np.asarray(tracers), dtype=torch.float32, device=device),
    )
    path = {name: getattr(evaluation.path, name).cpu().numpy() for name in ("x", "F")}
    write_arrays(
        output.rollout, {**path, "frames": np.asarray(params.frames)}, {"dt": params.simulation["dt"]}
    )
    stable = read_weights(inputs.adaptor)[1]["stable"] if inputs.get("adaptor") else True
    write_json(output.metrics, {**evaluation.metrics, "stable": stable})
    run.say(evaluation.summary())


if __name__ == "__main__":
    with stage(
        f"evaluation {snakemake.wildcards.scene}/{snakemake.wildcards.method}", snakemake.log[0]
    ) as run:
        main(snakemake.input, snakemake.output, snakemake.params, run)
