"""Compile a group of Warp kernels once, into the cache that all other rules share."""

from importlib import import_module

from neuma_lib.device import choose_device
from neuma_lib.io.files import write_text
from workflow.stage import run_script


def main(inputs, output, params, run) -> None:
    import_module(f"workflow.kernels.{params.group}").compile_kernels(choose_device(params.device))
    write_text(output.ready, f"{params.group}\n")
    run.log("compiled")


run_script(main, snakemake)
