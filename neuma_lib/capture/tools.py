"""Optional packages for captures."""

from __future__ import annotations

import signal
import threading
from types import ModuleType

from neuma_lib.extras import require


def opencv() -> ModuleType:
    """The module cv2. Raises InputError if it is not installed."""
    return require("cv2", "capture")


def colmap() -> ModuleType:
    """The module pycolmap. Raises InputError if it is not installed."""
    module = require("pycolmap", "capture")
    # Its handler of SIGTERM allocates memory for a stack trace and hangs if the signal interrupts an allocation.
    if threading.current_thread() is threading.main_thread():
        signal.signal(signal.SIGTERM, signal.getsignal(signal.SIGTERM) or signal.SIG_DFL)
    return module
