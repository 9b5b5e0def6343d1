"""Compile a group of Warp kernels once, into the cache that all other rules share."""

from importlib import import_module

from neuma_lib.device import choose_device
from neuma_lib.io.files import write_text
from workflow.stage import stage


def main(group: str, ready: str, device: str, run) -> None:
    import_module(f"workflow.kernels.{group}").compile_kernels(choose_device(device))
    write_text(ready, f"{group}\n")
    run.say("compiled")


if __name__ == "__main__":
    with stage(f"kernels {snakemake.wildcards.group}", snakemake.log[0]) as run:
        main(snakemake.wildcards.group, snakemake.output.ready, snakemake.params.device, run)
