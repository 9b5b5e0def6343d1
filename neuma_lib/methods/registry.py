"""All methods: the built-in ones, and those of installed packages (entry points of the group ``neuma.methods``)."""

from __future__ import annotations

from collections.abc import Mapping
from functools import cache
from importlib.metadata import entry_points
from typing import Any

from neuma_lib.methods.base import Method, method_of

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
ENTRY_POINTS = "neuma.methods"


@cache
def methods() -> Mapping[str, Method]:
    """Methods by name.

    Raises:
        LookupError: two methods have one name.
    """
    modules = [*BUILT_IN, *(point.module for point in entry_points(group=ENTRY_POINTS))]
    by_name: dict[str, Method] = {}
    for method in map(method_of, modules):
        if method.name in by_name:
            raise LookupError(f"two methods are called {method.name!r}")
        by_name[method.name] = method
    return by_name


def built_in_presets() -> dict[str, dict[str, Any]]:
    """Presets of all methods as settings: plain values by name."""
    presets = {}
    for method in methods().values():
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
