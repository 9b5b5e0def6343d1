"""Child processes that end with their parent, however it ends."""

import os
import subprocess
import sys
from collections.abc import Sequence
from typing import Any

_KILL_WITH_PARENT = """
import ctypes, os, signal, sys
ctypes.CDLL(None).prctl(1, signal.SIGKILL)
if os.getppid() == int(sys.argv[1]):
    os.execvp(sys.argv[2], sys.argv[2:])
"""  # 1 is PR_SET_PDEATHSIG, which exec keeps. The parent may have ended before, so it is compared afterwards.


def start_child(command: Sequence[str], **options: Any) -> subprocess.Popen:
    """Start a program. On Linux, the kernel kills it when the thread that started it ends, even by SIGKILL.

    Args:
        command: the program and its arguments.
        options: of `subprocess.Popen`. A ``preexec_fn`` would be unsafe here, because torch starts threads.
    """
    if sys.platform == "linux":
        command = [sys.executable, "-I", "-S", "-c", _KILL_WITH_PARENT, str(os.getpid()), *command]
    return subprocess.Popen(command, **options)
