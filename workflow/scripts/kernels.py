"""Compile every Warp kernel once, into the cache that all other rules share."""

from neuma_lib.device import choose_device
from neuma_lib.io import write_text
from neuma_lib.progress import stage
from neuma_lib.warm_up import compile_kernels


def main(ready: str, device: str, run) -> None:
    count = compile_kernels(choose_device(device), run.progress)
    write_text(ready, f"{count} pieces\n")
    run.say("kernels of simulator, laws and renderer are compiled")


if __name__ == "__main__":
    with stage("kernels", snakemake.log[0]) as run:
        main(snakemake.output.ready, snakemake.params.device, run)
