"""Unpack the ground truth of a scene."""

from neuma_lib.io.packed import unpack_truth
from workflow.stage import run_script


def main(inputs, output, params, run) -> None:
    unpack_truth(inputs.packed, output.particles, params.steps, params.dt)
    run.say(f"unpacked from {inputs.packed}")


run_script(main, snakemake)
