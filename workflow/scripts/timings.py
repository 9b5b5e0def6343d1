"""Seconds of every stage behind Table 1: wall time and memory from Snakemake's benchmark files, core seconds from logs.

Snakemake looks at a job's core seconds now and then only, and so misses up to half a minute of each.
"""

from pathlib import Path

from neuma_lib.evaluation.reports import report_table
from neuma_lib.io.files import write_text
from workflow.stage import core_seconds, run_script

TITLES = {
    "runs": "runs",
    "seconds": "all together [s]",
    "longest": "longest [s]",
    "core_seconds": "core seconds",
    "start": "of these to start",
    "memory": "most memory [MB]",
}
LARGEST = ("longest", "memory")  # other columns are sums


def main(inputs, output, params, run) -> None:
    rows: dict[str, dict[str, float]] = {}
    for file, log in zip(map(Path, list(inputs.benchmarks)), params.logs, strict=True):
        header, values = (line.split("\t") for line in file.read_text().splitlines()[:2])
        measured = dict(zip(header, values, strict=True))
        seconds, memory = float(measured["s"]), measured["max_rss"]
        start, work = core_seconds(log) or (0.0, 0.0)
        row = rows.setdefault(file.stem, dict.fromkeys(TITLES, 0))
        row["runs"] += 1
        row["seconds"] += seconds
        row["longest"] = max(row["longest"], seconds)
        row["core_seconds"] += start + work
        row["start"] += start
        row["memory"] = max(row["memory"], float(memory) if memory not in ("-", "NA") else 0.0)
    rows["total"] = {
        key: (max if key in LARGEST else sum)(row[key] for row in rows.values()) for key in TITLES
    }
    csv, markdown = report_table(rows, TITLES, "stage")
    write_text(output.csv, csv)
    write_text(output.markdown, markdown)
    run.say(f"{rows['total']['seconds']:.0f} s of work in {rows['total']['runs']} runs: {output.markdown}")


run_script(main, snakemake)
