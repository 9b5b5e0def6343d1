"""What all predictions of a body are measured with: tracers that fill it, and the sampling floor of its true motion."""

import numpy as np
import torch

from neuma_lib.geometry.chamfer import chamfer_sequence
from neuma_lib.geometry.volume import sample_tracers
from neuma_lib.io.hdf5 import read_arrays, write_arrays
from neuma_lib.io.mesh import read_mesh
from workflow.stage import run_script


def main(inputs, output, params, run) -> None:
    names = ("tracers", "tracers_again")
    truth, _ = read_arrays(inputs.truth, only=names, required=names)
    floor = chamfer_sequence(*(torch.from_numpy(truth[name]) for name in reversed(names)))
    count = params.tracers or truth["tracers"].shape[1]
    starts = np.asarray(sample_tracers(read_mesh(inputs.mesh), count, seed=params.seed), np.float32)
    write_arrays(output.tracers, {"starts": starts, "floor": floor.numpy()})
    run.log(f"{len(starts)} tracers, sampling floor {float(floor.mean()):.3f}e-4 m^2")


run_script(main, snakemake)
