"""The images of one of several bodies, with masks of the pixels that show it."""

from neuma_lib.io.images import list_body
from workflow.stage import run_script


def main(inputs, output, params, run) -> None:
    listed, count = list_body(inputs.transforms, output.transforms, 1 + params.bodies.index(params.body))
    run.log(f"visible in {listed} of {count} images")


run_script(main, snakemake)
