"""Simulate the ground-truth motion of a drop of the demo captures."""

import numpy as np

from neuma_lib.device import choose_device
from neuma_lib.io.hdf5 import write_arrays
from studies.capture_benchmark.drops import simulate_drop
from studies.capture_benchmark.settings import DemoCapturesConfig
from studies.capture_benchmark.stage import time_step
from workflow.stage import run_script


def main(inputs, output, params, run) -> None:
    demo = DemoCapturesConfig(**params.demo)
    truth = simulate_drop(demo, params.name, params.drop, choose_device(params.device))
    steps = np.asarray(truth.frames)
    arrays = {name: getattr(truth.path, name).numpy() for name in ("x", "v")}
    arrays |= {"frames": steps, "time": steps * time_step(demo)}
    arrays |= {name: getattr(truth, name).numpy() for name in ("tracers", "vol0", "mass")}
    write_arrays(output.particles, arrays, {"dt": time_step(demo)})
    lowest = arrays["x"][..., 1].min(axis=1)
    landed = arrays["time"][np.argmax(lowest < 0.5 / demo.truth.grid)]
    run.log(
        f"{len(arrays['mass'])} particles, {steps[-1]} steps, {len(steps)} states, on the floor after {landed:.3f} s"
    )


run_script(main, snakemake)
