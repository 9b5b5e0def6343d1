"""Pack the static and dynamic images of a scene into one file."""

from pathlib import Path

from neuma_lib.io.packed import pack_images
from workflow.stage import run_script


def main(inputs, output, params, run) -> None:
    pack_images(output.packed, {"static": inputs.static, "dynamic": inputs.dynamic}, run.progress)
    run.say(f"{Path(output.packed).stat().st_size / 1e6:.1f} MB: {output.packed}")


run_script(main, snakemake)
