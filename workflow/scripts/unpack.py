"""Unpack the static or the dynamic images of a scene, or its ground truth."""

from neuma_lib.io.packed import unpack_images, unpack_truth
from workflow.stage import run_script


def main(inputs, output, params, run) -> None:
    if params.part == "truth":
        unpack_truth(inputs.packed, output.particles, params.steps, params.dt)
    else:
        unpack_images(inputs.packed, params.part, output.transforms, params.steps, run.progress)
    run.say(f"unpacked from {inputs.packed}")


run_script(main, snakemake)
