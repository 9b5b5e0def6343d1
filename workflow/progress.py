"""One line a finished job on the terminal, in place of Snakemake's blocks. Snakemake's log file keeps them."""

import atexit
import logging
import os
import time
from collections import defaultdict
from collections.abc import Sequence
from datetime import timedelta
from pathlib import Path
from statistics import fmean
from typing import Any, TextIO

from snakemake.logging import DefaultFormatter, get_event, logger
from snakemake_interface_logger_plugins.common import LogEvent

from workflow.stage import ONE_LINE

LAST_LINES = 10  # of the log of a failed job
# Prefixes of messages that do not concern the work. Other messages are displayed.
ROUTINE = (
    "Building DAG of jobs",
    "Using shell:",
    "host:",
    "Assuming unrestricted shared filesystem",
    "Group jobs: inactive",
    "Conda environments: ignored",
    "Select jobs to execute",
    "DAG of jobs will be updated",
    "Complete log(s):",
    "Elapsed time:",
    "Shutting down, this might take some time.",
    "Exiting because a job execution failed.",
    "RuleException:\nCalledProcessError",  # `JobLines.end` names the cause
)


class JobLines(DefaultFormatter):
    """Formats the records of a run: a line at its start, one a finished job, one a failed job, errors and warnings.

    Args:
        log: file with the whole output; None if there is none.
        erase: what clears the line of a terminal, where a stage may have drawn its bar.
        clock: seconds, for tests.
    """

    def __init__(self, log: str | None = None, erase: str = "", clock=time.monotonic):
        super().__init__()
        self.erase = erase
        self.log, self.clock, self.began = log, clock, clock()
        self.names: dict[int, str] = {}
        self.rules: dict[int, str] = {}
        self.started: dict[int, float] = {}
        self.seconds: dict[str, list[float]] = defaultdict(list)  # of the finished jobs of each rule
        self.counts: dict[str, int] = {}  # jobs of each rule
        self.lines: list[str] = []  # of jobs that finished since the last state of the run
        self.failed: dict[str, Sequence[str]] = {}  # logs of failed jobs

    def filter(self, record: logging.LogRecord) -> bool:
        """Keep the start of a job from the handler, which writes an empty line before it."""
        if get_event(record) == LogEvent.JOB_INFO:
            self._start(record.__dict__)
            return False
        return True

    def format(self, record: logging.LogRecord) -> str:
        text = self._text(record)
        return text and self.erase + text

    def _text(self, record: logging.LogRecord) -> str:
        event, values = get_event(record), record.__dict__
        if event == LogEvent.RUN_INFO:
            return self._run(values["stats"])
        if event == LogEvent.JOB_FINISHED:
            self._finish(values["job_id"])
        elif event == LogEvent.PROGRESS:
            return self._progress(values["done"], values["total"])
        elif event == LogEvent.JOB_ERROR and values["log"]:
            name = self.names.get(values["jobid"], values["rule_name"])
            self.failed[name] = values["log"]
            return f"{self._time()} {name} failed"
        elif record.levelno > logging.INFO or event is None:
            text = super().format(record)
            return "" if text.startswith(ROUTINE) else text
        return ""

    def end(self, stream: TextIO) -> None:
        """Write the last lines of the logs of failed jobs, with their paths."""
        for name, logs in self.failed.items():
            for log in logs:
                try:
                    lines = Path(log).read_text(errors="replace").splitlines()[-LAST_LINES:]
                except OSError:
                    lines = []
                print(f"\n{name} failed. The end of {log}:", file=stream)
                print(*(lines or ["(empty)"]), sep="\n", file=stream)

    def _run(self, stats: dict[str, int]) -> str:
        self.counts = {rule: count for rule, count in stats.items() if rule != "total"}
        return f"{stats['total']} jobs" + (f"; the whole output of Snakemake: {self.log}" if self.log else "")

    def _start(self, values: dict[str, Any]) -> None:
        job, rule = values["jobid"], values["rule_name"]
        wildcards = "/".join(filter(None, map(str, values["wildcards"].values())))
        self.names[job], self.rules[job] = " ".join(filter(None, [rule, wildcards])), rule
        self.started[job] = self.clock()

    def _finish(self, job: int) -> None:
        if job not in self.started:
            return
        seconds = self.clock() - self.started.pop(job)
        self.seconds[self.rules[job]].append(seconds)
        self.lines.append(f"{self._time()} {self.names[job]}: {_duration(seconds, digits=1)}")

    def _progress(self, done: int, total: int) -> str:
        state = f"{done} of {total} jobs"
        if done < total and (left := self._left()):
            state += f", {left} left"
        lines, self.lines = self.lines, []
        return "\n".join(f"{line}; {state}" for line in lines)

    def _left(self) -> str:
        """Time left, from the mean seconds of the finished jobs of each rule and the jobs that ran at once.

        A rule without finished jobs takes the mean of all.
        """
        now, seconds = self.clock(), 0.0
        running: dict[str, list[float]] = defaultdict(list)
        for job, start in self.started.items():
            running[self.rules[job]].append(now - start)
        finished = [each for jobs in self.seconds.values() for each in jobs]
        if not finished:
            return ""
        for rule, count in self.counts.items():
            done = self.seconds.get(rule, [])
            mean = fmean(done or finished)
            seconds += sum(max(mean - each, 0.0) for each in running[rule])
            seconds += mean * max(count - len(done) - len(running[rule]), 0)
        at_once = (sum(finished) + sum(map(sum, running.values()))) / max(now - self.began, 1e-9)
        return f"about {_duration(seconds / max(at_once, 1.0))}"

    @staticmethod
    def _time() -> str:
        return time.strftime("[%H:%M:%S]")


def _duration(seconds: float, digits: int = 0) -> str:
    """Seconds below a minute, then minutes and seconds."""
    return (
        f"{seconds:.{digits}f} s" if seconds < 59.5 else str(timedelta(seconds=round(seconds))).lstrip("0:")
    )


def show_one_line_a_job(workflow) -> None:
    """Let the terminal of a run show `JobLines` from now on. Snakemake's log file is unchanged.

    Not in a dry run, in a job, or where an option asks for more or less (``-p``, ``--verbose``, ``--quiet``).
    """
    output = workflow.output_settings
    if (
        not workflow.is_main_process
        or output.dryrun
        or output.printshellcmds
        or output.verbose
        or output.quiet
    ):
        return
    os.environ[ONE_LINE] = "1"
    files = [handler.baseFilename for handler in logger.handlers if isinstance(handler, logging.FileHandler)]
    for handler in logger.handlers:
        if handler.name == "DefaultStreamHandler":
            lines = JobLines(files[0] if files else None, erase="\r\033[K" if handler.is_tty else "")
            handler.setFormatter(lines)
            handler.addFilter(lines)
            atexit.register(lines.end, handler.stream)
