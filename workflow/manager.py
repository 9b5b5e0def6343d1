"""The Snakemake process that a script works for.

A Snakemake that is killed outright (SIGKILL, out of memory) cannot stop its jobs; a second run would compute beside
them. A script therefore watches the outermost Snakemake above it and ends with it; its checkpoint keeps what was done.
"""

from __future__ import annotations

import os
import threading
import time
from contextlib import suppress
from pathlib import Path

import psutil

INTERVAL = 1.0  # seconds between two looks


def is_snakemake(process: psutil.Process) -> bool:
    """Whether a process runs Snakemake: ``python .../snakemake`` or ``python -m snakemake``."""
    with suppress(psutil.Error):
        python, *words = process.cmdline() or [""]
        return "python" in Path(python).name and any(Path(word).name == "snakemake" for word in words[:3])
    return False


def end_with_snakemake() -> None:
    """From now on end this process, with status 1, soon after the outermost Snakemake above it has ended."""
    above = [process for process in psutil.Process().parents() if is_snakemake(process)]
    if above:
        threading.Thread(target=_end_after, args=(above[-1],), daemon=True).start()


def _end_after(process: psutil.Process) -> None:
    with suppress(psutil.NoSuchProcess):
        while process.is_running() and process.status() != psutil.STATUS_ZOMBIE:
            time.sleep(INTERVAL)
    os._exit(1)
