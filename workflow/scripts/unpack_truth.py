"""Unpack the ground truth of a scene."""

from neuma_lib.io.packed import unpack_truth
from workflow.stage import stage


def main(packed: str, particles_file: str, params, run) -> None:
    unpack_truth(packed, particles_file, params.steps, params.dt)
    run.say(f"unpacked from {packed}")


if __name__ == "__main__":
    with stage(f"unpack_truth {snakemake.wildcards.scene}", snakemake.log[0]) as run:
        main(snakemake.input.packed, snakemake.output.particles, snakemake.params, run)
