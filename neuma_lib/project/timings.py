"""Wall time, core seconds and memory of the stages of a results folder, from benchmark files and logs."""

import re
from collections.abc import Mapping, Sequence
from pathlib import Path

from neuma_lib.errors import InputError
from neuma_lib.evaluation.text_tables import as_markdown
from neuma_lib.io.files import reading

COLUMNS = {
    "runs": "runs",
    "seconds": "all together [s]",
    "longest": "longest [s]",
    "core_seconds": "core seconds",
    "start": "of these to start",
    "memory": "most memory [MB]",
}
MAXIMA = ("longest", "memory")  # columns that hold the maximum over the runs; the others hold the sum

_USED = re.compile(r"core seconds: ([\d.]+) to start, ([\d.]+) of work(?:; memory: ([\d.]+) MB)?")


def timings_table(results: Path) -> str:
    """Markdown table with a row for each stage, the most expensive first, and their total.

    Core seconds and memory come from the logs. Snakemake samples a job only now and then, and misses up to
    30 s of each.

    Args:
        results: folder with the subfolders ``benchmarks`` and ``logs``.

    Raises:
        InputError: the folder has no benchmark file.
    """
    stages: dict[str, list[dict[str, float]]] = {}
    for file in sorted((results / "benchmarks").rglob("*.tsv")):
        log = results / "logs" / file.relative_to(results / "benchmarks").with_suffix(".log")
        stages.setdefault(file.stem, []).append(_measured(file, log))
    if not stages:
        raise InputError(results, "has no benchmarks", "Name the results folder of a finished run.")
    rows = {stage: _aggregate(runs) for stage, runs in stages.items()}
    rows = dict(sorted(rows.items(), key=lambda item: (-item[1]["core_seconds"], item[0])))
    rows["total"] = _aggregate(list(rows.values()))
    cells = [
        [stage, *(v if isinstance(v, int) else f"{v:.4g}" for v in row.values())]
        for stage, row in rows.items()
    ]
    return "\n".join(as_markdown(["stage", *COLUMNS.values()], cells, numbers=True)) + "\n"


def used(log: Path) -> tuple[float, float, float] | None:
    """Core seconds to start and to work, and most memory [MB] of a script, from its log; None if it did not finish."""
    runs = _USED.findall(log.read_text()) if log.exists() else []
    return tuple(float(value or 0) for value in runs[-1]) if runs else None


def _aggregate(runs: Sequence[Mapping[str, float]]) -> dict[str, float]:
    return {key: (max if key in MAXIMA else sum)(run[key] for run in runs) for key in COLUMNS}


def _measured(benchmark: Path, log: Path) -> dict[str, float]:
    """The columns of one run."""
    with reading(benchmark, "a benchmark of Snakemake"):
        header, values = (line.split("\t") for line in benchmark.read_text().splitlines()[:2])
        measured = dict(zip(header, values, strict=True))
        seconds, memory = float(measured["s"]), measured["max_rss"]
        memory = 0.0 if memory in ("-", "NA") else float(memory)
    start, work, most = used(log) or (0.0, 0.0, 0.0)
    return {
        "runs": 1,
        "seconds": seconds,
        "longest": seconds,
        "core_seconds": start + work,
        "start": start,
        "memory": max(memory, most),
    }
