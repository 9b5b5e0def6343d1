"""Remove the lock that a killed Snakemake left behind: ``make unlock``. Does nothing while another one is at work."""

import subprocess
import sys
from pathlib import Path

LOCKS = Path(".snakemake") / "locks"


def at_work() -> int | None:
    """Number of a Snakemake process that runs in this folder."""
    for process in Path("/proc").glob("[0-9]*"):
        try:
            here = (process / "cwd").resolve() == Path.cwd()
            words = (process / "cmdline").read_bytes().decode(errors="replace").split("\0")
        except OSError:
            continue
        if here and "python" in Path(words[0]).name and any(Path(w).name == "snakemake" for w in words[1:4]):
            return int(process.name)
    return None


def main() -> int:
    if not LOCKS.is_dir() or not any(LOCKS.iterdir()):
        return 0
    process = at_work()
    if process is not None:
        print(f"Another Snakemake (process {process}) is at work in this folder: let it finish, or stop it.")
        return 1
    print("Removing the lock that a killed Snakemake left behind.")
    return subprocess.run([sys.executable, "-m", "snakemake", "--unlock"]).returncode


if __name__ == "__main__":
    sys.exit(main())
