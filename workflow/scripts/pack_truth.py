"""Pack the ground truth of a scene."""

from pathlib import Path

from neuma_lib.io.packed import pack_truth
from workflow.stage import stage


def main(particles_file: str, packed: str, params, run) -> None:
    pack_truth(packed, particles_file, **params.packing, seed=params.seed)
    run.say(f"{Path(packed).stat().st_size / 1e6:.1f} MB: {packed}")


if __name__ == "__main__":
    with stage(f"pack_truth {snakemake.wildcards.scene}", snakemake.log[0]) as run:
        main(snakemake.input.particles, snakemake.output.packed, snakemake.params, run)
