"""Fill the reconstructed surface with particles."""

import numpy as np

from neuma_lib.geometry.volume import sample_volume
from neuma_lib.io.hdf5 import write_arrays
from neuma_lib.io.mesh import read_mesh
from workflow.stage import stage


def main(mesh_file: str, particles_file: str, params, run) -> None:
    mesh = read_mesh(mesh_file)
    x = np.asarray(
        sample_volume(mesh, params.wanted, seed=params.seed, method=params.sampling), dtype=np.float32
    )
    vol0 = np.full(len(x), mesh.volume / len(x), dtype=np.float32)
    write_arrays(particles_file, {"x": x, "vol0": vol0}, {"volume": float(mesh.volume)})
    run.say(f"{len(x)} particles (asked: {params.wanted}) in {1e3 * mesh.volume:.3f} l")


if __name__ == "__main__":
    with stage(f"sampled_particles {snakemake.wildcards.scene}", snakemake.log[0]) as run:
        main(snakemake.input.mesh, snakemake.output.particles, snakemake.params, run)
