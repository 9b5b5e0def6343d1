"""Results of methods on scenes, read from their files."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
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


def seen_everywhere(metrics: Mapping[str, Mapping[str, Any]], scenes: Iterable[str]) -> list[str]:
    """Methods whose images were measured in views of their training in all scenes, where not all methods' were.

    Args:
        metrics: {method: {scene: image_metrics.json}}.
    """
    scenes = list(scenes)
    found = [m for m, row in metrics.items() if all(row[s]["views_seen_in_training"] for s in scenes)]
    return found if len(found) < len(metrics) else []


def seen_in_training(metrics: Mapping[str, Mapping[str, Any]], scenes: Iterable[str]) -> list[str]:
    """Scenes whose images were measured in a view of the training, from {method: {scene: image_metrics.json}}."""
    return [s for s in scenes if any(row[s]["views_seen_in_training"] for row in metrics.values())]
