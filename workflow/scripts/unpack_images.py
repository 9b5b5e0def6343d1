"""Unpack the static or the dynamic images of a scene."""

from neuma_lib.io.packed import unpack_images
from workflow.stage import stage


def main(packed: str, transforms: str, params, run) -> None:
    unpack_images(packed, {params.part: transforms}, {params.part: params.steps}, run.progress)
    run.say(f"unpacked from {packed}")


if __name__ == "__main__":
    with stage(f"{snakemake.rule} {snakemake.wildcards.scene}", snakemake.log[0]) as run:
        main(snakemake.input.packed, snakemake.output.transforms, snakemake.params, run)
