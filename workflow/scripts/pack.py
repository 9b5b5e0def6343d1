"""Pack the images of a scene into one file, and its ground truth into another."""

from pathlib import Path

from neuma_lib.io.packed import pack_images, pack_truth
from workflow.stage import run_script


def main(inputs, output, params, run) -> None:
    pack_images(output.images, {"static": inputs.static, "dynamic": inputs.dynamic}, run.progress)
    pack_truth(output.truth, inputs.particles, **params.packing, seed=params.seed)
    for packed in output:
        run.say(f"{Path(packed).stat().st_size / 1e6:.1f} MB: {packed}")


run_script(main, snakemake)
