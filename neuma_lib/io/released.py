"""Image sets in the layout of the authors' released data, read as they are.

``<scene>/data_dynamic.json`` and ``eval_dynamic.json`` are lists of {``file_path``, ``c2w``, ``intrinsic``} over RGBA
images named ``<letter>_<view>_<step>.png``. This module turns such a list into the content of our transforms.json;
`neuma_lib.io.files` reads either.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from neuma_lib.errors import InputError

_NAME = re.compile(r"[a-z]+_(\d+)_(\d+)$", re.IGNORECASE)


def released_frames(entries: Sequence[Mapping[str, Any]], path: str | Path) -> list[dict[str, Any]]:
    """Frames as transforms.json holds them.

    Args:
        entries: the list: ``c2w`` camera to world, OpenGL axes, 4 x 4 (or its first three rows); ``intrinsic``, 3 x 3
            [px]. Where a file's name tells no view and step, each image is a view of its own at step 0.
        path: the list's file, for messages.

    Raises:
        InputError: names the file, the entry and what is wrong with it.
    """
    frames = []
    for i, entry in enumerate(entries):
        if not isinstance(entry, Mapping) or "file_path" not in entry:
            raise InputError(f"{path}: entry {i} has no file_path: is this a list of images?")
        where = f"{path}: entry {i} ({entry['file_path']})"
        pose = _matrix(entry, "c2w", [(4, 4), (3, 4)], where)
        K = _matrix(entry, "intrinsic", [(3, 3)], where)
        if np.abs(K[[0, 1, 2, 2, 2], [1, 0, 0, 1, 2]] - [0, 0, 0, 0, 1]).max() > 1e-9:
            raise InputError(f"{where}: intrinsic is not that of a pinhole camera without skew")
        named = _NAME.fullmatch(Path(entry["file_path"]).stem)
        view, step = map(int, named.groups()) if named else (i, 0)
        frames.append(
            {
                "file_path": entry["file_path"],
                "transform_matrix": [*pose[:3].tolist(), [0.0, 0.0, 0.0, 1.0]],
                **{"fl_x": K[0, 0], "fl_y": K[1, 1], "cx": K[0, 2], "cy": K[1, 2]},
                "view": view,
                "step": step,
            }
        )
    return frames


def _matrix(entry: Mapping[str, Any], key: str, shapes: Sequence[tuple[int, int]], where: str) -> np.ndarray:
    """A matrix of numbers of one of the shapes."""
    try:
        matrix = np.asarray(entry.get(key), dtype=np.float64)
    except (TypeError, ValueError):
        matrix = np.empty(0)
    if matrix.shape not in shapes:
        raise InputError(f"{where}: {key} must be a {shapes[0][0]}x{shapes[0][1]} matrix of numbers")
    return matrix
