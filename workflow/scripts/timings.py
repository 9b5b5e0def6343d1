"""Seconds of every stage behind Table 1, from Snakemake's benchmark files."""

from pathlib import Path

from neuma_lib.evaluation.reports import report_table
from neuma_lib.io.files import write_text
from workflow.stage import run_script


def main(inputs, output, params, run) -> None:
    rows: dict[str, dict[str, float]] = {}
    for file in map(Path, list(inputs.benchmarks)):
        header, values = (line.split("\t") for line in file.read_text().splitlines()[:2])
        measured = dict(zip(header, values, strict=True))
        seconds, memory = float(measured["s"]), measured["max_rss"]
        row = rows.setdefault(file.stem, {"runs": 0, "seconds": 0.0, "longest": 0.0, "memory": 0.0})
        row["runs"] += 1
        row["seconds"] += seconds
        row["longest"] = max(row["longest"], seconds)
        row["memory"] = max(row["memory"], float(memory) if memory not in ("-", "NA") else 0.0)
    rows["total"] = {
        "runs": sum(r["runs"] for r in rows.values()),
        "seconds": sum(r["seconds"] for r in rows.values()),
        "longest": max((r["longest"] for r in rows.values()), default=0.0),
        "memory": max((r["memory"] for r in rows.values()), default=0.0),
    }
    titles = {
        "runs": "runs",
        "seconds": "all together [s]",
        "longest": "longest [s]",
        "memory": "most memory [MB]",
    }
    csv, markdown = report_table(rows, titles, "stage")
    write_text(output.csv, csv)
    write_text(output.markdown, markdown)
    run.say(f"{rows['total']['seconds']:.0f} s of work in {rows['total']['runs']} runs: {output.markdown}")


run_script(main, snakemake)
