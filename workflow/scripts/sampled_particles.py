"""Fill the reconstructed surface with particles."""

import numpy as np

from neuma_lib.geometry.volume import sample_volume
from neuma_lib.io.hdf5 import write_arrays
from neuma_lib.io.mesh import read_mesh
from workflow.stage import run_script


def main(inputs, output, params, run) -> None:
    mesh = read_mesh(inputs.mesh)
    x = np.asarray(
        sample_volume(mesh, params.wanted, seed=params.seed, method=params.sampling), dtype=np.float32
    )
    vol0 = np.full(len(x), mesh.volume / len(x), dtype=np.float32)
    write_arrays(output.particles, {"x": x, "vol0": vol0}, {"volume": float(mesh.volume)})
    run.log(f"{len(x)} particles (asked: {params.wanted}) in {1e3 * mesh.volume:.3f} l")


run_script(main, snakemake)
