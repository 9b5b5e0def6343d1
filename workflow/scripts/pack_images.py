"""Pack the static and dynamic images of a scene into one file."""

from pathlib import Path

from neuma_lib.io.packed import pack_images
from workflow.stage import stage


def main(inputs, packed: str, run) -> None:
    pack_images(packed, {"static": inputs.static, "dynamic": inputs.dynamic}, run.progress)
    run.say(f"{Path(packed).stat().st_size / 1e6:.1f} MB: {packed}")


if __name__ == "__main__":
    with stage(f"pack_images {snakemake.wildcards.scene}", snakemake.log[0]) as run:
        main(snakemake.input, snakemake.output.packed, run)
