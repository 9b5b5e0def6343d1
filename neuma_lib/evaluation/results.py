"""Results of methods on scenes, read from their files."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any

from neuma_lib.io.files import read_json


def read_results(
    files: Iterable[str],
    methods: Iterable[str],
    scenes: Iterable[str],
    value: Callable[[Any], Any] = lambda content: content,
) -> dict[str, dict[str, Any]]:
    """What JSON files hold, {method: {scene: value}}.

    Args:
        files: one of every method on every scene, method by method.
        value: what is taken from the content of each.
    """
    files = iter(files)
    return {method: {scene: value(read_json(next(files))) for scene in scenes} for method in methods}
