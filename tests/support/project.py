"""A copy of the project in its own folder, run by real Snakemake on the settings of tiny.yaml."""

import hashlib
import json
import re
import shutil
import signal
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import yaml

ROOT = Path(__file__).resolve().parents[2]
PARTS = (
    "Snakefile",
    "Makefile",
    "pyproject.toml",
    "config",
    "envs",
    "neuma_lib",
    "profiles",
    "studies",
    "workflow",
    "tests/workflow/tiny.yaml",
    "tests/workflow/capture_benchmark.yaml",
)
TABLE = "tiny/results/table1.csv"
SCENE = "tiny/results/BouncyBall"


def wait_for(condition, seconds: float = 60.0):
    """Wait until the condition is true and return its value."""
    end = time.monotonic() + seconds
    while not (value := condition()):
        assert time.monotonic() < end, "waited in vain"
        time.sleep(0.02)
    return value


@dataclass(frozen=True)
class Job:
    """A job as Snakemake prints it, in a dry run or when it starts."""

    rule: str
    text: str

    def listed(self, key: str) -> list[str]:
        line = re.search(rf"^    {key}: (.*)$", self.text, re.MULTILINE)
        return line[1].split(", ") if line else []

    @cached_property
    def inputs(self) -> list[str]:
        return self.listed("input")

    @cached_property
    def outputs(self) -> list[str]:
        return self.listed("output")


class Plan(Counter):
    """Rules with the number of their jobs, and the jobs of a run or a dry run.

    Args:
        requested: options of Snakemake, with the targets.
    """

    def __init__(self, jobs: Iterable[Job], requested: Iterable[str] = ()):
        self.jobs, self.requested = list(jobs), {*requested}
        super().__init__(job.rule for job in self.jobs)

    @classmethod
    def of(cls, output: str, requested: Iterable[str] = ()) -> "Plan":
        """Jobs that Snakemake prints. Raises AssertionError if these are not all that it counts."""
        blocks = re.findall(r"^(?:local)?rule (\w+):\n((?:    .*\n)*)", output, re.MULTILINE)
        plan = cls((Job(*block) for block in blocks), requested)
        assert "Nothing to be done" in output or re.search(
            rf"^total +{len(plan.jobs)}$", output, re.MULTILINE
        )
        return plan

    def of_rule(self, rule: str) -> list[Job]:
        return [job for job in self.jobs if job.rule == rule]

    def one(self, rule: str) -> Job:
        """The only job of a rule."""
        (job,) = self.of_rule(rule)
        return job

    @cached_property
    def makers(self) -> dict[str, Job]:
        """The job of each output; a target rule is its own output."""
        return {name: job for job in self.jobs for name in job.outputs or [job.rule]}

    def behind(self, *targets: str) -> "Plan":
        """The jobs that a dry run of these targets alone would have, with the present files."""
        unknown = {*targets} - self.makers.keys() - self.requested
        assert not unknown, unknown
        chosen, open_files = {}, list(targets)
        while open_files:
            job = self.makers.get(open_files.pop())
            if job and job not in chosen:
                chosen[job] = None
                open_files += job.inputs
        return Plan(chosen)


def overlay(**settings) -> tuple[str, ...]:
    """Options of Snakemake that change sections of the settings. Targets follow them."""
    return "--config", *(f"{name}={json.dumps(value)}" for name, value in settings.items()), "--"


class Project:
    """A copy of the working tree in its own folder.

    Args:
        root: that folder.
        executor: options of Snakemake that state where jobs run.
        seconds: the longest that a run may take.
    """

    def __init__(self, root: Path, executor: tuple[str, ...] = ("--cores", "2"), seconds: float = 900.0):
        self.root, self.executor, self.seconds = root, executor, seconds

    def command(self, *words: str) -> list[str]:
        return [
            sys.executable,
            "-m",
            "snakemake",
            "--configfile",
            "tests/workflow/tiny.yaml",
            "--printshellcmds",  # all that Snakemake prints, not `workflow.progress`
            *self.executor,
            *words,
        ]

    def run(self, *words: str, succeeds: bool = True) -> str:
        """Run Snakemake; its output."""
        done = subprocess.run(
            self.command(*words),
            cwd=self.root,
            text=True,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            timeout=self.seconds,
        )
        assert (done.returncode == 0) == succeeds, done.stdout[-4000:]
        return done.stdout

    def plan(self, *words: str) -> Plan:
        """The jobs that Snakemake would run."""
        return Plan.of(self.run("--dry-run", *words), words)

    def start(self, *words: str) -> subprocess.Popen:
        """Start Snakemake as the leader of a separate process group."""
        with open(self.root / "started.log", "w") as log:
            return subprocess.Popen(
                self.command(*words),
                cwd=self.root,
                stdout=log,
                stderr=subprocess.STDOUT,
                start_new_session=True,
                # A shell lets what it starts in the background ignore SIGINT.
                preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
            )

    def processes(self, script: str) -> list[int]:
        """Running Python processes of a script of this copy."""
        numbers = []
        for process in Path("/proc").glob("[0-9]*"):
            try:
                here = (process / "cwd").resolve() == self.root
                words = (process / "cmdline").read_bytes().split(b"\0")
            except OSError:
                continue
            if here and b"python" in words[0] and any(w.endswith(f".{script}.py".encode()) for w in words):
                numbers.append(int(process.name))
        return numbers

    def artifacts(self) -> dict[str, str]:
        """Digests of all data and results; logs and benchmarks are no artifacts."""
        files = [f for f in (self.root / "tiny").rglob("*") if f.is_file()]
        kept = {str(f.relative_to(self.root)): f for f in files if not {"logs", "benchmarks"} & set(f.parts)}
        return {name: hashlib.sha256(f.read_bytes()).hexdigest() for name, f in sorted(kept.items())}

    def clone(self, root: Path) -> "Project":
        """A copy of the project as it stands, with everything computed and Snakemake's records."""
        shutil.copytree(self.root, root)
        return Project(root.resolve(), self.executor, self.seconds)


def copied(folder: Path, kernels: Path, origin: Path = ROOT) -> Project:
    """A copy of the sources at ``origin`` in its own folder."""
    for part in PARTS:
        source, target = origin / part, folder / part
        target.parent.mkdir(parents=True, exist_ok=True)
        if source.is_dir():
            shutil.copytree(source, target, ignore=shutil.ignore_patterns("__pycache__"))
        else:
            shutil.copy2(source, target)
    settings = yaml.safe_load((ROOT / "tests" / "workflow" / "tiny.yaml").read_text())
    (folder / "tests" / "workflow" / "tiny.yaml").write_text(
        yaml.safe_dump({**settings, "kernel_cache": str(kernels)})
    )
    return Project(folder.resolve())
