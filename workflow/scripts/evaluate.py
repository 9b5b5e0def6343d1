"""Predict a motion from the estimated start, and compare it with the ground truth."""

import numpy as np
import torch

from neuma_lib.device import choose_device
from neuma_lib.evaluation.motion import evaluate
from neuma_lib.io.files import write_json
from neuma_lib.io.hdf5 import read_arrays, write_arrays
from neuma_lib.io.simulator import simulator
from workflow.motion import Prediction
from workflow.stage import run_script


def main(inputs, output, params, run) -> None:
    device, dt = choose_device(params.device), params.simulation["dt"]
    names = ("tracers", "tracers_again")
    truth, _ = read_arrays(inputs.truth, only=(*names, "tracer_body"), required=names)
    owners = torch.from_numpy(truth["tracer_body"]) if "tracer_body" in truth else None
    measure, _ = read_arrays(inputs.tracers, required=("starts", "floor"))
    prediction = Prediction(inputs, params.method)
    start, counts = prediction.start(params.densities, params.particle_source)
    model = prediction.model(dt, counts)
    evaluation = evaluate(
        simulator(params.simulation),
        model,
        start.to(device),
        params.frames,
        torch.from_numpy(truth["tracers"]).to(device),
        torch.from_numpy(truth["tracers_again"]).to(device),
        torch.from_numpy(measure["starts"]).to(device),
        total=params.total,
        floor=torch.from_numpy(measure["floor"]),
        owners=owners,
    )
    arrays = evaluation.path.arrays()
    write_arrays(output.rollout, {**arrays, "frames": np.asarray(params.frames)}, {"dt": dt})
    write_json(output.metrics, {**evaluation.metrics, "stable": model.stable})
    run.log(evaluation.summary())
    for k, errors in enumerate(evaluation.metrics.get("bodies", ())):
        run.log(f"body {k + 1}: tracer RMSE {errors['tracer_rmse_mm']:.2f} mm")


run_script(main, snakemake)
