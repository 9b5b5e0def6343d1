"""Roll a law out from a stated start, where there is no truth to compare with."""

from dataclasses import asdict

import numpy as np

from neuma_lib.device import choose_device
from neuma_lib.evaluation.motion import energy_gain_after, predict
from neuma_lib.io.files import write_json
from neuma_lib.io.hdf5 import write_arrays
from neuma_lib.io.laws import load_laws
from neuma_lib.io.particles import load_initial_state
from neuma_lib.io.weights import read_weights
from neuma_lib.sim.model import MPMModel, consecutive
from workflow.inputs import listed
from workflow.stage import run_script


def main(inputs, output, params, run) -> None:
    device = choose_device(params.device)
    files = [inputs[name] for name in ("particles", "binding", "gaussians", "velocity")]
    start, counts = load_initial_state(*files, [params.density], params.carrier)
    identified, adaptors = listed(inputs.get("identified")), listed(inputs.get("adaptor"))
    laws = load_laws(params.simulation["dt"], params.laws, identified, listed(inputs.prior), adaptors)
    model, start = MPMModel(**params.simulation), start.to(device)
    bodies = consecutive([law.to(device) for law in laws], counts)
    path, failure = predict(model, bodies, start, params.frames, total=params.total)
    arrays = {name: getattr(path, name) for name in ("x", "F", "F_total")}
    arrays = {name: values.cpu().numpy() for name, values in arrays.items() if values is not None}
    write_arrays(
        output.rollout, {**arrays, "frames": np.asarray(params.frames)}, {"dt": params.simulation["dt"]}
    )
    gain = energy_gain_after(model.gravity, start, path)
    report = {
        "diverged": failure and asdict(failure),
        "energy_gain_after_step": gain,
        "stable": all(read_weights(adaptor)[1]["stable"] for adaptor in adaptors),
    }
    write_json(output.report, report)
    said = f"{len(params.frames)} frames, {params.frames[-1] * params.simulation['dt']:.3f} s"
    if failure:
        said += f"; DIVERGED: a particle {failure.happened} at step {failure.step}"
    run.say(said)


run_script(main, snakemake)
