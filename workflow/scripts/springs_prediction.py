"""Let fitted springs move the body of a throw that was filmed, to every step that its frames and exposures need."""

import numpy as np

from neuma_lib.config.springs import SpringsConfig
from neuma_lib.device import choose_device
from neuma_lib.evaluation.springs import predict_springs
from neuma_lib.io.hdf5 import write_arrays
from neuma_lib.io.images import filmed_steps
from neuma_lib.io.particles import load_initial_state
from neuma_lib.io.springs import load_springs
from neuma_lib.sim.model import MPMModel
from neuma_lib.springs.body import SpringBody
from neuma_lib.springs.rollout import SpringModel
from workflow.stage import run_script


def main(inputs, output, params, run) -> None:
    how, device = SpringsConfig(**params.springs), choose_device(params.device)
    start, _ = load_initial_state(
        *(inputs[name] for name in ("particles", "binding", "gaussians", "velocity")), [params.density]
    )
    start = start.to(device)
    index, springs, about = load_springs(inputs.springs, start.x)
    body = SpringBody.with_network(start.x, index, springs.network, how.carriers)
    frames = sorted({0, *filmed_steps(inputs.transforms, params.views, **params.filming)})
    model = SpringModel.of(MPMModel(**params.simulation), about["substeps"])
    path, failure = predict_springs(model, body, springs, start, frames, start.x[:0], how.carriers)
    found = {name: getattr(path, name).cpu().numpy() for name in ("x", "F")}
    write_arrays(output.rollout, {**found, "frames": np.asarray(frames)}, {"dt": params.simulation["dt"]})
    broken = f"; DIVERGED at step {failure.step}" if failure else ""
    run.say(f"{len(frames)} states to step {frames[-1]}{broken}")


run_script(main, snakemake)
