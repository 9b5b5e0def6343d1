"""The Snakemake process of a script.

A Snakemake that is killed (SIGKILL, out of memory) cannot stop its jobs, and a second run would compute the same at the
same time. A script therefore watches the outermost Snakemake above it and ends with it. Its checkpoint keeps the work.
"""

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
