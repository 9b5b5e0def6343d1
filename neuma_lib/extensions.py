"""Own methods and laws: Python files that the setting `extensions` names, and entry points of installed packages."""

import importlib
import importlib.util
import sys
from collections.abc import Iterable
from functools import cache
from importlib.metadata import entry_points
from pathlib import Path
from types import ModuleType

from neuma_lib.errors import InputError

LAW_GROUP, METHOD_GROUP = "neuma.laws", "neuma.methods"  # groups of entry points


def load_module(name: str) -> ModuleType:
    """Import a module by its name, or a Python file by its path, which becomes the name of the module.

    Raises:
        InputError: the file does not exist or cannot be imported.
    """
    if not name.endswith(".py"):
        return importlib.import_module(name)
    path = Path(name).resolve()
    known = sys.modules.get(name)
    if known is not None and known.__file__ == str(path):
        return known
    if not path.is_file():
        remedy = "Paths are relative to the working directory, not to the settings file"
        raise InputError(f"extensions: {name}", f"the file {path} does not exist", remedy)
    spec = importlib.util.spec_from_file_location(name, path)
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module
    try:
        spec.loader.exec_module(module)
    except Exception as error:
        del sys.modules[name]
        if isinstance(error, InputError):
            raise
        raise InputError(name, f"it cannot be imported: {type(error).__name__}: {error}") from error
    return module


def load_laws(files: Iterable[str]) -> None:
    """Import the laws of installed packages and the extensions of a project, which registers their laws."""
    _load_installed_laws()
    for file in files:
        load_module(file)


@cache
def _load_installed_laws() -> None:
    for point in entry_points(group=LAW_GROUP):
        importlib.import_module(point.module)
