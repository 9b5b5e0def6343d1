"""Optional packages for captures."""

from __future__ import annotations

import importlib
import signal
import threading
from types import ModuleType

from neuma_lib.errors import InputError


def opencv() -> ModuleType:
    """The module cv2. Raises InputError if it is not installed."""
    return _module("cv2", "OpenCV")


def colmap() -> ModuleType:
    """The module pycolmap. Raises InputError if it is not installed."""
    module = _module("pycolmap", "COLMAP")
    # Its handler of SIGTERM allocates memory for a stack trace and hangs if the signal interrupts an allocation.
    if threading.current_thread() is threading.main_thread():
        signal.signal(signal.SIGTERM, signal.getsignal(signal.SIGTERM) or signal.SIG_DFL)
    return module


def _module(name: str, title: str) -> ModuleType:
    try:
        return importlib.import_module(name)
    except ImportError as error:
        raise InputError(
            name, f"captures require {title} ({error})", "Install the extra with `make capture`"
        ) from None
