"""Predict a motion without a truth: a take at the steps of its frames, or a splat."""

from dataclasses import asdict

import numpy as np

from neuma_lib.capture.report.motion import motion_report
from neuma_lib.device import choose_device
from neuma_lib.evaluation.motion import energy_gain_after
from neuma_lib.io.files import write_json
from neuma_lib.io.hdf5 import write_arrays
from neuma_lib.io.images import filmed_steps, read_transforms
from neuma_lib.io.simulator import simulator
from workflow.motion import Prediction
from workflow.stage import run_script


def main(inputs, output, params, run) -> None:
    device, dt = choose_device(params.device), params.simulation["dt"]
    prediction = Prediction(inputs, params.method)
    start, counts = prediction.start(params.densities, params.particle_source)
    start, model, mpm = start.to(device), prediction.model(dt, counts), simulator(params.simulation)
    frames = params.frames
    if params.cameras:
        steps = filmed_steps(inputs.transforms, range(len(params.cameras)), **params.exposure)
        frames = sorted({0, *steps})
    path, failure = model.predict(mpm, start, frames, total=params.total)
    about = {"dt": dt, "particles": counts}  # of each body
    write_arrays(output.rollout, {**path.arrays(), "frames": np.asarray(frames)}, about)
    message = f"{len(frames)} states to step {frames[-1]}, {frames[-1] * dt:.3f} s"
    if params.cameras:
        filmed = {camera: [] for camera in params.cameras}
        for frame in read_transforms(inputs.transforms)["frames"]:
            filmed[params.cameras[frame["view"]]].append(frame["step"])
        report = motion_report(mpm, path, start, frames, filmed, params.scale)
        touched = f", touches {', '.join(report['touched'])}" if report["touched"] else ""
        message += f", first contact at {report['contact_step']}{touched}"
    else:
        report = {"diverged": None, "energy_gain_after_step": energy_gain_after(mpm.gravity, start, path)}
    report |= {"diverged": failure and asdict(failure), "stable": model.stable}
    write_json(output.report, report)
    run.log(
        message + (f". DIVERGED: a particle {failure.happened} at step {failure.step}" if failure else "")
    )


run_script(main, snakemake)
