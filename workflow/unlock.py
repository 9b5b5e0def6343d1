"""Remove the lock that a killed Snakemake left behind: ``make unlock``. Does nothing while another one is at work."""

import subprocess
import sys
import time
from contextlib import suppress
from pathlib import Path

import psutil

from neuma_lib.io.files import one_line
from workflow.manager import is_snakemake

LOCKS = Path(".snakemake") / "locks"


def others() -> list[str]:
    """Descriptions of other Snakemake processes at work in this folder, if it is locked."""
    if not LOCKS.is_dir() or not any(LOCKS.iterdir()):
        return []
    here, own = str(Path.cwd()), psutil.Process()
    family = {own.pid, *(process.pid for process in own.parents())}
    processes = []
    for process in psutil.process_iter(["cwd"]):
        with suppress(psutil.Error):
            if process.info["cwd"] != here or process.pid in family or not is_snakemake(process):
                continue
            if (parent := process.parent()) and is_snakemake(parent):  # a job of it
                continue
            started = time.strftime("%H:%M:%S", time.localtime(process.create_time()))
            command = " ".join(process.cmdline()[1:])
            processes.append(f"process {process.pid}, started at {started}: {one_line(command)}")
    return processes


def main() -> int:
    if not LOCKS.is_dir() or not any(LOCKS.iterdir()):
        return 0
    if busy := others():
        print(f"Another Snakemake ({busy[0]}) is at work in this folder: let it finish, or stop it.")
        return 1
    print("Removing the lock that a killed Snakemake left behind.")
    return subprocess.run([sys.executable, "-m", "snakemake", "--unlock"]).returncode


if __name__ == "__main__":
    sys.exit(main())
