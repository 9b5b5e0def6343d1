"""The patches of Snakemake, against the installed one."""

import shutil
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
SNAKEFILE = """
import sys
sys.path.insert(0, {root!r})
from workflow.records import keep_records_of_failed_jobs

onstart:
    if {patched}:
        keep_records_of_failed_jobs(workflow.persistence)

rule table:
    input: "law.txt"
    output: "table.txt"
    shell: "cp {{input}} {{output}}"

rule law:
    output: "law.txt"
    params: value=config["value"]
    shell: "test ! -e broken && echo {{params.value}} > {{output}}"
"""

DELETED = """
import sys
sys.path.insert(0, {root!r})
from workflow.records import remake_deleted_folders
if {patched}:
    remake_deleted_folders("results")

rule table:
    input: "results/neuma/law.txt"
    output: "table.txt"
    shell: "cp {{input}} {{output}}"

rule law:
    output: "results/neuma/law.txt"
    shell: "echo 1 > {{output}}"
"""

MANY = """
import sys
sys.path.insert(0, {root!r})
from workflow.records import start_local_jobs_at_once

onstart:
    if {patched}:
        start_local_jobs_at_once(workflow)

rule all:
    input: expand("{{number}}.txt", number=range(16))

rule one:
    output: "{{number}}.txt"
    shell: "sleep 2 && touch {{output}}"
"""


@pytest.mark.parametrize("patched", [True, False])
def test_a_failed_job_counts_as_out_of_date(tmp_path, patched):
    """Without the patch it does not. When this changes in Snakemake, remove the patch."""
    (tmp_path / "Snakefile").write_text(SNAKEFILE.format(root=str(ROOT), patched=patched))

    def run(value, *options):
        command = [sys.executable, "-m", "snakemake", "--cores", "1", *options, "--config", f"value={value}"]
        done = subprocess.run([*command, "--", "table.txt"], cwd=tmp_path, capture_output=True, text=True)
        return done.returncode, done.stdout + done.stderr

    assert run(1)[0] == 0
    (tmp_path / "broken").touch()
    assert run(2)[0] != 0 and not (tmp_path / "law.txt").exists()
    (tmp_path / "broken").unlink()
    status, plan = run(2, "--dry-run")
    assert status == 0 and ("Nothing to be done" in plan) != patched


@pytest.mark.parametrize("patched", [True, False])
def test_a_deleted_folder_is_made_again_for_a_table(tmp_path, patched):
    """Without the patch it is not. A single deleted file is not made again either."""
    (tmp_path / "Snakefile").write_text(DELETED.format(root=str(ROOT), patched=patched))

    def run(*options):
        command = [sys.executable, "-m", "snakemake", "--cores", "1", "--rerun-incomplete", *options]
        done = subprocess.run([*command, "table.txt"], cwd=tmp_path, capture_output=True, text=True)
        assert done.returncode == 0
        return "Nothing to be done" in done.stdout + done.stderr

    assert not run() and run()
    folder = tmp_path / "results/neuma"
    (folder / "law.txt").unlink()
    assert run("--dry-run")
    shutil.rmtree(folder)
    assert run() != patched and (folder / "law.txt").exists() == patched
    assert run()


@pytest.mark.parametrize("patched", [True, False])
def test_jobs_are_selected_when_one_ends_and_not_all_the_time(tmp_path, patched):
    """Without the patch they are selected more often the more jobs have ended."""
    (tmp_path / "Snakefile").write_text(MANY.format(root=str(ROOT), patched=patched))
    command = [sys.executable, "-m", "snakemake", "--cores", "4", "--scheduler", "greedy", "--verbose"]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    selections = (done.stdout + done.stderr).count("Ready jobs:")
    ends = 17
    assert 4 <= selections <= ends if patched else selections > ends
