"""The start of a splat, which its scene states, in the form in which it is estimated of others."""

from neuma_lib.io.files import write_json
from workflow.stage import run_script


def main(inputs, output, params, run) -> None:
    v0, spin = params.start["velocity"], params.start["spin"]
    write_json(output.velocity, {"v0": v0, "angular_velocity": spin, "centre": None})


run_script(main, snakemake)
