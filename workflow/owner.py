"""Work that ends with the process it is done for.

A workflow manager that is killed outright (SIGKILL, out of memory) cannot stop its jobs; a second run would then
compute beside them. A stage therefore watches the process that owns it and stops when that one is gone; its
checkpoint keeps what was done. Linux only (it reads /proc); elsewhere nothing is watched.
"""

from __future__ import annotations

import os
import socket
import threading
import time
from pathlib import Path

VARIABLE = "NEUMA_OWNER"
INTERVAL = 1.0  # seconds between two looks


def claim() -> None:
    """Make this process the owner of all stages that it starts, unless it has an owner itself."""
    if _alive(os.environ.get(VARIABLE, "")) is not True:
        os.environ[VARIABLE] = _name(os.getpid())


def stop_with_owner() -> None:
    """From now on end this process, with status 1, soon after its owner has ended.

    Does nothing without an owner, or with one on another machine.
    """
    owner = os.environ.get(VARIABLE, "")
    if _alive(owner) is not True:
        return

    def watch() -> None:
        while _alive(owner):
            time.sleep(INTERVAL)
        os._exit(1)

    threading.Thread(target=watch, daemon=True, name="owner").start()


def _name(process: int) -> str:
    """Host, number and start time: unlike a number alone, no other process ever has the same."""
    return f"{socket.gethostname()} {process} {_start_time(process)}"


def _alive(name: str) -> bool | None:
    """Whether a named process lives; None if that cannot be known here."""
    parts = name.split()
    if len(parts) != 3 or parts[0] != socket.gethostname() or parts[2] == "None":
        return None
    return _start_time(int(parts[1])) == int(parts[2])


def _start_time(process: int) -> int | None:
    """Start time of a live process in clock ticks since boot; None if there is no such process."""
    try:
        fields = Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()
    except OSError:
        return None
    return None if fields[0] == "Z" else int(fields[19])
