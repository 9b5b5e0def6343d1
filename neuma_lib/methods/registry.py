"""All methods: the built-in ones, those of installed packages (entry points ``neuma.methods``) and of extensions."""

from collections.abc import Mapping
from functools import cache
from importlib.metadata import entry_points
from typing import Any

from neuma_lib.errors import InputError
from neuma_lib.extensions import METHOD_GROUP
from neuma_lib.methods.base import Method, method_of, methods_in

BUILT_IN = (
    "neuma_lib.methods.prior",
    "neuma_lib.methods.neuma",
    "neuma_lib.methods.true_law",
    "neuma_lib.methods.constants",
    "neuma_lib.methods.structured",
    "neuma_lib.methods.spring_gaus.method",
    "neuma_lib.methods.pac_nerf.method",
)
"""Modules of the built-in methods, in the order of their rows in tables."""


@cache
def methods(extensions: tuple[str, ...] = ()) -> Mapping[str, Method]:
    """Methods by name.

    Args:
        extensions: Python files. A file without a method has laws only.

    Raises:
        InputError: two methods have one name, a file has several methods or cannot be imported.
    """
    modules = [*BUILT_IN, *(point.module for point in entry_points(group=METHOD_GROUP))]
    modules += [file for file in extensions if methods_in(file)]
    by_name: dict[str, Method] = {}
    for module in modules:
        method = method_of(module)
        if method.name in by_name:
            other = type(by_name[method.name]).__module__
            raise InputError(module, f"{other} has a method with the same name {method.name!r}", "Rename one")
        by_name[method.name] = method
    return by_name


def built_in_presets(extensions: tuple[str, ...] = ()) -> dict[str, dict[str, Any]]:
    """Presets of all methods as settings: plain values by name."""
    presets = {}
    for method in methods(extensions).values():
        for name, preset in method.presets.items():
            presets[name] = {
                "kind": method.name,
                "title": preset.title,
                "note": preset.note,
                "same_fit_as": preset.same_fit_as,
                "evaluate_on": preset.evaluate_on,
                "options": dict(preset.options),
            }
    return presets


METHODS: Mapping[str, Method] = methods()
"""Built-in methods and those of installed packages, by name."""
