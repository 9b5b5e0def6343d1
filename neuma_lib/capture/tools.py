"""The packages that only captures need; they are an extra of the project."""

from __future__ import annotations

import importlib
from types import ModuleType

from neuma_lib.errors import InputError


def opencv() -> ModuleType:
    """The module cv2. Raises InputError where it is not installed."""
    return _module("cv2", "OpenCV")


def colmap() -> ModuleType:
    """The module pycolmap. Raises InputError where it is not installed."""
    return _module("pycolmap", "COLMAP")


def _module(name: str, what: str) -> ModuleType:
    try:
        return importlib.import_module(name)
    except ImportError as error:
        raise InputError(
            f"captures need {what} ({error}): install the project's extra with `make capture`"
        ) from None
