"""Unpack the static or the dynamic images of a scene."""

from neuma_lib.io.packed import unpack_images
from workflow.stage import run_script


def main(inputs, output, params, run) -> None:
    unpack_images(inputs.packed, {params.part: output.transforms}, {params.part: params.steps}, run.progress)
    run.say(f"unpacked from {inputs.packed}")


run_script(main, snakemake)
