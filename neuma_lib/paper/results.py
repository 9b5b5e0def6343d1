"""Read results of methods on scenes."""

from collections.abc import Callable, Iterable, Mapping
from typing import Any

from neuma_lib.io.files import read_json


def read_results(
    files: Iterable[str],
    methods: Iterable[str],
    scenes: Iterable[str],
    value: Callable[[Any], Any] = lambda content: content,
) -> dict[str, dict[str, Any]]:
    """Content of JSON files, {method: {scene: value}}.

    Args:
        files: one for each method and scene, method by method.
        value: selects a part of the content of each.
    """
    files = iter(files)
    return {method: {scene: value(read_json(next(files))) for scene in scenes} for method in methods}


def seen_everywhere(metrics: Mapping[str, Mapping[str, Any]], scenes: Iterable[str]) -> list[str]:
    """Methods evaluated in training views in all scenes. Empty if this holds for all methods.

    Args:
        metrics: {method: {scene: image_metrics.json}}.
    """
    scenes = list(scenes)
    methods = [m for m, row in metrics.items() if all(row[s]["views_seen_in_training"] for s in scenes)]
    return methods if len(methods) < len(metrics) else []


def seen_in_training(metrics: Mapping[str, Mapping[str, Any]], scenes: Iterable[str]) -> list[str]:
    """Scenes with images in a training view, from {method: {scene: image_metrics.json}}."""
    return [s for s in scenes if any(row[s]["views_seen_in_training"] for row in metrics.values())]
