"""One line a finished job, and the end of a failed job's log."""

import logging
import subprocess
import sys

from snakemake_interface_logger_plugins.common import LogEvent

from tests.support.project import ROOT
from workflow.progress import JobLines

SNAKEFILE = """
import sys
sys.path.insert(0, {root!r})
from workflow.progress import show_one_line_a_job
show_one_line_a_job(workflow)

rule table:
    input: "a.txt", "b.txt"

rule law:
    output: "{{name}}.txt"
    log: "{{name}}.log"
    shell: "echo {{wildcards.name}} > {{log}}; test {{wildcards.name}} != b && touch {{output}}"
"""


class Run:
    """Formats events of a run with a clock that is set by hand."""

    def __init__(self):
        self.now = 0.0
        self.lines = JobLines(log="snakemake.log", clock=lambda: self.now)

    def event(self, event=None, message=None, level=logging.INFO, **values):
        record = logging.LogRecord("snakemake", level, "", 0, message, None, None)
        record.__dict__.update(values, **({"event": event} if event else {}))
        return self.lines.format(record) if self.lines.filter(record) else None

    def start(self, job, rule, **wildcards):
        return self.event(LogEvent.JOB_INFO, jobid=job, rule_name=rule, wildcards=wildcards)

    def finish(self, job, done, total):
        assert not self.event(LogEvent.JOB_FINISHED, "Finished", job_id=job)
        return self.event(LogEvent.PROGRESS, done=done, total=total)


def test_a_line_for_each_finished_job():
    run = Run()
    stats = {"fit": 3, "evaluate": 1, "total": 4}
    assert run.event(LogEvent.RUN_INFO, "Job stats:", stats=stats).startswith("4 jobs")
    assert run.start(0, "fit", scene="Ball", method="neuma") is None
    run.now = 10.0
    line = run.finish(0, 1, 4)
    # One job of 10 s at a time. Two of them remain, and a job of another rule, which is taken to last as long.
    assert "fit Ball/neuma: 10.0 s; 1 of 4 jobs, about 30 s left" in line
    run.start(1, "fit", scene="Cat", method="neuma")
    run.start(2, "evaluate", scene="Ball")
    run.now = 14.0
    assert "evaluate Ball: 4.0 s; 2 of 4 jobs, about 12 s left" in run.finish(2, 2, 4)


def test_time_left_counts_jobs_that_run_at_once():
    run = Run()
    run.event(LogEvent.RUN_INFO, "Job stats:", stats={"fit": 4, "total": 4})
    for job in (0, 1):
        run.start(job, "fit", scene=f"scene{job}")
    run.now = 60.0
    run.finish(0, 1, 4)
    assert "2 of 4 jobs, about 1:00 left" in run.finish(1, 2, 4)


def test_routine_messages_are_hidden_and_others_shown():
    run = Run()
    assert run.event(message="Building DAG of jobs...") == ""
    assert run.event(LogEvent.RESOURCES_INFO, "Provided cores: 2") == ""
    assert run.event(message="Nothing to be done.") == "Nothing to be done."
    assert run.event(message="disk is full", level=logging.WARNING) == "disk is full"
    assert run.event(message="MissingOutputException", level=logging.ERROR) == "MissingOutputException"


def test_a_run_ends_with_the_log_of_the_failed_job(tmp_path):
    (tmp_path / "Snakefile").write_text(SNAKEFILE.format(root=str(ROOT)))

    def run(*options):
        command = [sys.executable, "-m", "snakemake", "--cores", "1", "--keep-going", *options, "table"]
        done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True)
        assert done.returncode != 0
        return done.stderr.splitlines()

    lines = run()
    assert lines[-2:] == ["law b failed. The end of b.log:", "b"]
    (finished,) = [line for line in lines if " law a: " in line]
    assert "1 of 3 jobs" in finished and len(lines) < 15
    assert any("rule law:" in line for line in run("--printshellcmds"))
