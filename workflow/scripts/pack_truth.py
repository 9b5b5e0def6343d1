"""Pack the ground truth of a scene."""

from pathlib import Path

from neuma_lib.io.packed import pack_truth
from workflow.stage import run_script


def main(inputs, output, params, run) -> None:
    pack_truth(output.packed, inputs.particles, **params.packing, seed=params.seed)
    run.say(f"{Path(output.packed).stat().st_size / 1e6:.1f} MB: {output.packed}")


run_script(main, snakemake)
