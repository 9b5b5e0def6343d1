"""Copy tables and figures of a run to docs/results, with the machine, the commit and the date above each table.

python docs/record.py            # after: snakemake --cores 2 tables figures
"""

from __future__ import annotations

import argparse
import datetime
import platform
import shutil
import subprocess
from pathlib import Path

from PIL import Image

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

WIDTH = 1400
"""Of figures on a page [px]; in print they are larger."""


def processor() -> str:
    """Name of the processor, as Linux tells it."""
    for line in Path("/proc/cpuinfo").read_text().splitlines():
        if line.startswith("model name"):
            return line.partition(":")[2].strip()
    return platform.processor()


def head() -> str:
    """The commit that is checked out."""
    found = subprocess.run(["git", "rev-parse", "--short", "HEAD"], capture_output=True, text=True)
    return found.stdout.strip() or "unknown"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--results", default="results", help="folder of the run")
    parser.add_argument("--out", default="docs/results", help="folder to write to")
    parser.add_argument(
        "--machine", default=f"2 cores of {processor()}, no GPU", help="what the run was computed on"
    )
    parser.add_argument(
        "--tables", nargs="*", default=TABLES, help="tables to copy; figures are always copied"
    )
    parser.add_argument("--commit", default=head(), help="code of the run")
    options = parser.parse_args()
    results, out = Path(options.results), Path(options.out)
    out.mkdir(parents=True, exist_ok=True)
    origin = (
        f"{datetime.date.today()}, commit {options.commit}, {options.machine},"
        " default settings (`config/config.yaml`). Made by `snakemake tables figures` and `python docs/record.py`."
    )
    for name in options.tables:
        source = results / f"{name}.md"
        if source.exists():
            (out / f"{name}.md").write_text(f"{origin}\n\n{source.read_text()}")
            shutil.copyfile(source.with_suffix(".csv"), out / f"{name}.csv")
    for picture in sorted((results / "figures").glob("*.png")):
        (out / "figures").mkdir(exist_ok=True)
        with Image.open(picture) as image:
            size = WIDTH, round(image.height * WIDTH / image.width)
            small = image.convert("RGB").resize(size, Image.LANCZOS)
        small.save(out / "figures" / picture.name, optimize=True)


if __name__ == "__main__":
    main()
