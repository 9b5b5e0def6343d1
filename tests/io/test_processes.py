"""Child processes end with their parent."""

import os
import signal
import subprocess
import sys
import time

import pytest

PARENT = """
import subprocess, time
from neuma_lib.io.processes import start_child
child = start_child(["sleep", "60"])
print(child.pid, flush=True)
time.sleep(60)
"""


def running(pid):
    try:
        with open(f"/proc/{pid}/stat") as file:
            return file.read().rpartition(")")[2].split()[0] != "Z"
    except FileNotFoundError:
        return False


@pytest.mark.skipif(sys.platform != "linux", reason="Linux only")
@pytest.mark.parametrize("delay", [0.0, 0.01, 0.3])
def test_a_child_ends_when_its_parent_is_killed(delay):
    """At any time after the start, also before the child has asked the kernel for it."""
    with subprocess.Popen([sys.executable, "-c", PARENT], stdout=subprocess.PIPE, text=True) as parent:
        child = int(parent.stdout.readline())
        time.sleep(delay)
        parent.send_signal(signal.SIGKILL)
    end = time.monotonic() + 5
    try:
        while running(child) and time.monotonic() < end:
            time.sleep(0.01)
        assert not running(child)
    finally:
        if running(child):
            os.kill(child, signal.SIGKILL)
