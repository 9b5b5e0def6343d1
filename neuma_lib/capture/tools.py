"""The packages that only captures need; they are an extra of the project."""

from __future__ import annotations

import signal
import threading
from types import ModuleType

from neuma_lib.extras import require


def opencv() -> ModuleType:
    """The module cv2. Raises InputError where it is not installed."""
    return require("cv2", "capture")


def colmap() -> ModuleType:
    """The module pycolmap. Raises InputError where it is not installed."""
    found = require("pycolmap", "capture")
    # Its handler of SIGTERM writes a stack trace, for which it allocates memory; sent amid an allocation, it never
    # ends.
    if threading.current_thread() is threading.main_thread():
        signal.signal(signal.SIGTERM, signal.getsignal(signal.SIGTERM) or signal.SIG_DFL)
    return found
