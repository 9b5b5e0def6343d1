"""Let fitted springs move their body, or another of the same material, and compare it with the ground truth."""

import numpy as np
import torch

from neuma_lib.config.springs import SpringsConfig
from neuma_lib.device import choose_device
from neuma_lib.evaluation.springs import evaluate_springs
from neuma_lib.io.files import write_json
from neuma_lib.io.hdf5 import read_arrays, write_arrays
from neuma_lib.io.particles import load_initial_state
from neuma_lib.io.springs import load_springs
from neuma_lib.sim.model import MPMModel
from neuma_lib.springs.body import SpringBody
from neuma_lib.springs.rollout import SpringModel
from workflow.stage import run_script


def main(inputs, output, params, run) -> None:
    how, device = SpringsConfig(**params.springs), choose_device(params.device)
    truth, _ = read_arrays(
        inputs.truth, only=("tracers", "tracers_again"), required=("tracers", "tracers_again")
    )
    measure, _ = read_arrays(inputs.tracers, required=("starts", "floor"))
    files = [inputs[name] for name in ("particles", "binding", "gaussians", "velocity")]
    start, _ = load_initial_state(*files, params.densities)
    start = start.to(device)
    index, springs, about = load_springs(inputs.springs, start.x)
    if params.other_body:
        network = (how.anchors, how.neighbours, how.hard_springs, how.exponent, how.carriers)
        body = SpringBody.of(start.x, *network)
        density = float(start.mass.sum() / start.vol0.sum())
        springs = springs.for_network(body.network, about["density"], density)
    else:
        body = SpringBody.with_network(start.x, index, springs.network, how.carriers)
    evaluation = evaluate_springs(
        SpringModel.of(MPMModel(**params.simulation), about["substeps"]),
        body,
        springs,
        start,
        params.frames,
        torch.from_numpy(truth["tracers"]).to(device),
        torch.from_numpy(truth["tracers_again"]).to(device),
        torch.from_numpy(measure["starts"]).to(device),
        how.carriers,
        floor=torch.from_numpy(measure["floor"]),
    )
    path = {name: getattr(evaluation.path, name).cpu().numpy() for name in ("x", "F")}
    write_arrays(
        output.rollout, {**path, "frames": np.asarray(params.frames)}, {"dt": params.simulation["dt"]}
    )
    write_json(output.metrics, {**evaluation.metrics, "stable": about["stable"]})
    run.say(evaluation.summary())


run_script(main, snakemake)
