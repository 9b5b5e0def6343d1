"""The patch of Snakemake's records, against the installed Snakemake."""

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
