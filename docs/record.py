"""Copy the tables of a finished run to docs/results, with the machine, the commit and the date above each.

python docs/record.py            # after: snakemake --cores 2 tables results/figures/main_res.png
"""

from __future__ import annotations

import argparse
import datetime
import platform
import shutil
import subprocess
from pathlib import Path

TABLES = (
    "table1",
    "table2",
    "table3",
    "table4",
    "table5",
    "uneven_mass",
    "initial_states",
    "timings",
    "learning_rates",
)


def processor() -> str:
    """Name of the processor, as Linux tells it."""
    for line in Path("/proc/cpuinfo").read_text().splitlines():
        if line.startswith("model name"):
            return line.partition(":")[2].strip()
    return platform.processor()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--results", default="results", help="folder of the run")
    parser.add_argument("--out", default="docs/results", help="folder to write to")
    parser.add_argument("--cores", type=int, default=2, help="cores that Snakemake was given")
    options = parser.parse_args()
    results, out = Path(options.results), Path(options.out)
    out.mkdir(parents=True, exist_ok=True)
    commit = subprocess.run(
        ["git", "rev-parse", "--short", "HEAD"], capture_output=True, text=True
    ).stdout.strip()
    origin = (
        f"{datetime.date.today()}, commit {commit or 'unknown'}, {options.cores} cores of {processor()}, no GPU,"
        " default settings (`config/config.yaml`). Made by `snakemake --cores 2 tables` and `python docs/record.py`."
    )
    for name in TABLES:
        source = results / f"{name}.md"
        if source.exists():
            (out / f"{name}.md").write_text(f"{origin}\n\n{source.read_text()}")
            shutil.copyfile(source.with_suffix(".csv"), out / f"{name}.csv")
    picture = results / "figures" / "main_res.png"
    if picture.exists():
        shutil.copyfile(picture, out / "main_res.png")


if __name__ == "__main__":
    main()
