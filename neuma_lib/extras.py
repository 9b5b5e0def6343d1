"""Packages of the optional extras, imported where they are used."""

import importlib
from types import ModuleType

from neuma_lib.errors import InputError

TARGETS = {
    "workflow": "env",
    "blender": "env",
    "capture": "capture",
    "viewer": "viewer",
    "engines": "engines",
}
"""Target of the Makefile that installs the pinned versions of an extra."""


def require(module: str, extra: str) -> ModuleType:
    """Import a module that an extra of the distribution installs.

    Args:
        module: for example ``"matplotlib.figure"``.
        extra: for example ``"workflow"``.

    Raises:
        InputError: the module cannot be imported.
    """
    try:
        return importlib.import_module(module)
    except ImportError as error:
        raise InputError(
            module.partition(".")[0],
            f"the package cannot be imported: {error}",
            f'Install it with `pip install "neuma[{extra}]"`, in the project\'s folder with `make {TARGETS[extra]}`',
        ) from None
