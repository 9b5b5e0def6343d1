"""Remove the lock that a killed Snakemake left behind: ``make unlock``. Does nothing while another one is at work."""

import subprocess
import sys
from pathlib import Path

import psutil

from workflow.manager import is_snakemake

LOCKS = Path(".snakemake") / "locks"


def main() -> int:
    if not LOCKS.is_dir() or not any(LOCKS.iterdir()):
        return 0
    here = str(Path.cwd())
    for process in psutil.process_iter(["cwd"]):
        if process.info["cwd"] == here and is_snakemake(process):
            print(
                f"Another Snakemake (process {process.pid}) is at work in this folder: let it finish, or stop it."
            )
            return 1
    print("Removing the lock that a killed Snakemake left behind.")
    return subprocess.run([sys.executable, "-m", "snakemake", "--unlock"]).returncode


if __name__ == "__main__":
    sys.exit(main())
