"""Predict a take at every step required by its frames and their exposures."""

from dataclasses import asdict

import numpy as np

from neuma_lib.device import choose_device
from neuma_lib.evaluation.captured_motion import motion_report
from neuma_lib.evaluation.motion import predict
from neuma_lib.io.files import write_json
from neuma_lib.io.hdf5 import write_arrays
from neuma_lib.io.images import filmed_steps, read_transforms
from neuma_lib.io.laws import load_laws
from neuma_lib.io.particles import load_initial_state
from neuma_lib.io.weights import read_weights
from neuma_lib.sim.model import MPMModel, consecutive
from workflow.inputs import listed
from workflow.stage import run_script


def main(inputs, output, params, run) -> None:
    device, dt = choose_device(params.device), params.simulation["dt"]
    files = [inputs[name] for name in ("particles", "binding", "gaussians", "velocity")]
    start, counts = load_initial_state(*files, [params.density], params.carrier)
    adaptors = listed(inputs.get("adaptor"))
    laws = load_laws(dt, (), listed(inputs.get("identified")), listed(inputs.prior), adaptors)
    steps = filmed_steps(inputs.transforms, range(len(params.cameras)), **params.filming)
    frames = sorted({0, *steps})
    model = MPMModel(**params.simulation)
    bodies = consecutive([law.to(device) for law in laws], counts)
    path, failure = predict(model, bodies, start.to(device), frames, total=params.total)
    states = {name: getattr(path, name) for name in ("x", "F", "F_total")}
    arrays = {name: values.cpu().numpy() for name, values in states.items() if values is not None}
    write_arrays(output.rollout, {**arrays, "frames": np.asarray(frames)}, {"dt": dt})
    filmed = {camera: [] for camera in params.cameras}
    for frame in read_transforms(inputs.transforms)["frames"]:
        filmed[params.cameras[frame["view"]]].append(frame["step"])
    report = motion_report(model, path, start.mass.to(device), frames, filmed, params.scale)
    report["diverged"] = asdict(failure) if failure else None
    report["stable"] = all(read_weights(adaptor)[1]["stable"] for adaptor in adaptors)
    write_json(output.report, report)
    touched = f", touches {', '.join(report['touched'])}" if report["touched"] else ""
    diverged = f", DIVERGED at step {failure.step}" if failure else ""
    contact = report["contact_step"]
    run.say(f"{len(frames)} states to step {frames[-1]}, first contact at step {contact}{touched}{diverged}")


run_script(main, snakemake)
