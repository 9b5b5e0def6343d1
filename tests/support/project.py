"""A copy of the project in a folder of its own, run by real Snakemake on the settings of tiny.yaml."""

from __future__ import annotations

import hashlib
import re
import shutil
import subprocess
import sys
import time
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


class Project:
    """A copy of the working tree in a folder of its own.

    Args:
        root: that folder.
        executor: options of Snakemake that say where jobs run.
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

    def plan(self, *words: str) -> dict[str, int]:
        """Rules that Snakemake would run, with the number of their jobs."""
        text = self.run("--dry-run", *words)
        stats = re.search(r"^job +count\n[- ]+\n(.*?)^total", text, re.MULTILINE | re.DOTALL)
        assert stats or "Nothing to be done" in text, text[-4000:]
        return {line.split()[0]: int(line.split()[1]) for line in stats[1].splitlines()} if stats else {}

    def start(self, *words: str) -> subprocess.Popen:
        """Start Snakemake as the leader of a process group of its own."""
        with open(self.root / "started.log", "w") as log:
            return subprocess.Popen(
                self.command(*words),
                cwd=self.root,
                stdout=log,
                stderr=subprocess.STDOUT,
                start_new_session=True,
            )

    def processes(self, script: str) -> list[int]:
        """Running Python processes of a script of this copy."""
        found = []
        for process in Path("/proc").glob("[0-9]*"):
            try:
                here = (process / "cwd").resolve() == self.root
                words = (process / "cmdline").read_bytes().split(b"\0")
            except OSError:
                continue
            if here and b"python" in words[0] and any(w.endswith(f".{script}.py".encode()) for w in words):
                found.append(int(process.name))
        return found

    def artifacts(self) -> dict[str, str]:
        """Digests of all data and results; logs and benchmarks are no artifacts."""
        files = [f for f in (self.root / "tiny").rglob("*") if f.is_file()]
        kept = {str(f.relative_to(self.root)): f for f in files if not {"logs", "benchmarks"} & set(f.parts)}
        return {name: hashlib.sha256(f.read_bytes()).hexdigest() for name, f in sorted(kept.items())}

    def clone(self, root: Path) -> Project:
        """A copy of the project as it stands, with everything computed and Snakemake's records."""
        shutil.copytree(self.root, root)
        return Project(root.resolve(), self.executor, self.seconds)


def copied(folder: Path, kernels: Path, origin: Path = ROOT) -> Project:
    """A copy of the sources at ``origin`` in a folder of its own."""
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
