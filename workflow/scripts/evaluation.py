"""Roll learned laws, true or identified ones, out from the estimated start and compare them with the ground truth."""

import numpy as np
import torch

from neuma_lib.device import choose_device
from neuma_lib.evaluation.motion import evaluate
from neuma_lib.fitting.carried_field import CarriedField
from neuma_lib.io.files import write_json
from neuma_lib.io.hdf5 import read_arrays, write_arrays
from neuma_lib.io.laws import load_laws
from neuma_lib.io.particles import load_initial_state, with_motion
from neuma_lib.io.weights import read_weights
from neuma_lib.sim.model import MPMModel, consecutive
from workflow.inputs import listed
from workflow.stage import run_script


def main(inputs, output, params, run) -> None:
    device = choose_device(params.device)
    truth, _ = read_arrays(
        inputs.truth, only=("tracers", "tracers_again"), required=("tracers", "tracers_again")
    )
    measure, _ = read_arrays(inputs.tracers, required=("starts", "floor"))
    files = [inputs[name] for name in ("particles", "binding", "gaussians", "velocity")]
    if params.own:
        body = CarriedField.load(inputs.field, params.own, params.densities[0])
        start, counts = with_motion(body, inputs.velocity), [len(body.moving.x)]
    else:
        start, counts = load_initial_state(*files, params.densities, params.carrier)
    identified, adaptors = listed(inputs.get("identified")), listed(inputs.get("adaptor"))
    laws = load_laws(params.simulation["dt"], params.laws, identified, listed(inputs.prior), adaptors)
    evaluation = evaluate(
        MPMModel(**params.simulation),
        consecutive([law.to(device) for law in laws], counts),
        start.to(device),
        params.frames,
        torch.from_numpy(truth["tracers"]).to(device),
        torch.from_numpy(truth["tracers_again"]).to(device),
        torch.from_numpy(measure["starts"]).to(device),
        total=params.total,
        floor=torch.from_numpy(measure["floor"]),
    )
    found = {name: getattr(evaluation.path, name) for name in ("x", "F", "F_total")}
    path = {name: values.cpu().numpy() for name, values in found.items() if values is not None}
    write_arrays(
        output.rollout, {**path, "frames": np.asarray(params.frames)}, {"dt": params.simulation["dt"]}
    )
    stable = all(read_weights(adaptor)[1]["stable"] for adaptor in adaptors)
    write_json(output.metrics, {**evaluation.metrics, "stable": stable})
    run.say(evaluation.summary())


run_script(main, snakemake)
