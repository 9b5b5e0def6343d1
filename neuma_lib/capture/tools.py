"""The packages that only captures need; they are an extra of the project."""

from __future__ import annotations

import importlib
import signal
import threading
from types import ModuleType

from neuma_lib.errors import InputError


def opencv() -> ModuleType:
    """The module cv2. Raises InputError where it is not installed."""
    return _module("cv2", "OpenCV")


def colmap() -> ModuleType:
    """The module pycolmap. Raises InputError where it is not installed."""
    found = _module("pycolmap", "COLMAP")
    # Its handler of SIGTERM writes a stack trace, for which it allocates memory; sent amid an allocation, it never
    # ends.
    if threading.current_thread() is threading.main_thread():
        signal.signal(signal.SIGTERM, signal.getsignal(signal.SIGTERM) or signal.SIG_DFL)
    return found


def _module(name: str, what: str) -> ModuleType:
    try:
        return importlib.import_module(name)
    except ImportError as error:
        raise InputError(
            f"captures need {what} ({error}): install the project's extra with `make capture`"
        ) from None
