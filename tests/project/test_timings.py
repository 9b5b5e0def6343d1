"""Time and memory of the stages of a results folder."""

import subprocess
import sys
from pathlib import Path

import pytest

from neuma_lib.errors import InputError
from neuma_lib.project.timings import timings_table, used

ROOT = Path(__file__).resolve().parents[2]
LOG = "[2026-11-22 10:00:00,000] core seconds: {} to start, {} of work\n"
WITH_MEMORY = LOG.replace("work", "work; memory: 800.5 MB")


def record(results, job, seconds, memory, log=""):
    for folder, ending, text in (
        ("benchmarks", "tsv", f"s\th:m:s\tmax_rss\tcpu_time\n{seconds}\t0:00:01\t{memory}\t0.5\n"),
        ("logs", "log", log),
    ):
        file = results / folder / f"{job}.{ending}"
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(text)


def test_runs_of_a_stage_are_summed_and_the_most_expensive_stage_is_first(tmp_path):
    record(tmp_path, "A/mesh", 10.5, 300, WITH_MEMORY.format(1, 2))
    record(tmp_path, "A/neuma/material", 100, "NA", LOG.format(9, 9) + LOG.format(2, 80))
    record(tmp_path, "B+seed=1/neuma/material", 50, 700.25, LOG.format(2.5, 40))
    record(tmp_path, "chamfer_table", 0.25, "-", "ended before its core seconds were logged")
    assert timings_table(tmp_path).splitlines() == [
        "| stage | runs | all together [s] | longest [s] | core seconds | of these to start | most memory [MB] |",
        "|---|---:|---:|---:|---:|---:|---:|",
        "| material | 2 | 150 | 100 | 124.5 | 4.5 | 700.2 |",
        "| mesh | 1 | 10.5 | 10.5 | 3 | 1 | 800.5 |",
        "| chamfer_table | 1 | 0.25 | 0.25 | 0 | 0 | 0 |",
        "| total | 4 | 160.8 | 100 | 127.5 | 5.5 | 800.5 |",
    ]


def test_a_folder_without_benchmarks_is_refused(tmp_path):
    with pytest.raises(InputError) as caught:
        timings_table(tmp_path)
    assert caught.value.where == str(tmp_path)


def test_torch_is_not_imported():
    code = "import sys, neuma_lib.project.timings; sys.exit('torch' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], cwd=ROOT).returncode == 0


def test_a_script_logs_its_core_seconds_for_the_start_and_for_the_work(tmp_path):
    log = tmp_path / "rule.log"
    script = f"""
import time
from types import SimpleNamespace
from workflow.stage import run_script

def burn(seconds):
    end = time.process_time() + seconds
    while time.process_time() < end:
        pass

def main(inputs, output, params, run):
    burn(0.5)

burn(1.0)
snakemake = SimpleNamespace(rule="rule", wildcards=[], log=[{str(log)!r}], config={{}}, input=0, output=0, params=0)
run_script(main, snakemake)
"""
    done = subprocess.run([sys.executable, "-c", script], cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0 and "core seconds" not in done.stderr
    start, work, memory = used(log)
    assert 10 < memory < 4000
    assert start >= 1.0 and 0.5 <= work < 1.0
    assert used(tmp_path / "none.log") is None
