"""The true motion of one of several bodies, next to the others."""

from scipy.spatial import cKDTree

from neuma_lib.io.hdf5 import read_arrays, write_arrays
from workflow.stage import run_script

PARTICLES = {"x": 1, "v": 1, "F": 1, "vol0": 0, "mass": 0}  # arrays of particles, and their axis


def main(inputs, output, params, run) -> None:
    arrays, attributes = read_arrays(inputs.truth)
    body = params.bodies.index(params.body)
    own, tracers = arrays.pop("body") == body, arrays.pop("tracer_body") == body
    _, nearest = cKDTree(arrays["tracers"][0]).query(arrays["tracers_again"][0])
    arrays |= {name: arrays[name].compress(own, axis) for name, axis in PARTICLES.items()}
    arrays |= {
        "tracers": arrays["tracers"][:, tracers],
        "tracers_again": arrays["tracers_again"][:, tracers[nearest]],
    }
    write_arrays(output.truth, arrays, {**attributes, "bodies": [attributes["bodies"][body]]})
    run.log(f"{int(own.sum())} particles, {int(tracers.sum())} tracers")


run_script(main, snakemake)
