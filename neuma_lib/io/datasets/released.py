"""Image sets in the layout of the authors' released data.

``<scene>/data_dynamic.json`` and ``eval_dynamic.json`` are lists of {``file_path``, ``c2w``, ``intrinsic``} over RGBA
images named ``<letter>_<view>_<step>.png``. This module converts them to our transforms.json; `neuma_lib.io.images`
reads both.
"""

import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from neuma_lib.errors import InputError

MAX_POSITION = 1e6  # maximum coordinate of a camera [m]
_NAME = re.compile(r"[a-z]+_(\d{1,9})_(\d{1,9})$", re.IGNORECASE)


def released_frames(entries: Sequence[Mapping[str, Any]], path: str | Path) -> list[dict[str, Any]]:
    """Frames in the format of transforms.json.

    Args:
        entries: the list: ``c2w`` camera to world, OpenGL axes, 4 x 4 (or its first three rows); ``intrinsic``, 3 x 3
            [px]. A file whose name contains no view and step is a separate view at step 0.
        path: the list's file, for messages.

    Raises:
        InputError: names the file and the wrong entry.
    """
    frames = []
    for i, entry in enumerate(entries):
        name = image_name(entry, f"{path}: entry {i}")
        where = f"{path}: entry {i} ({name})"
        named = _NAME.fullmatch(Path(name).stem)
        view, step = map(int, named.groups()) if named else (i, 0)
        frames.append({"file_path": name, **camera(entry, where), "view": view, "step": step})
    return frames


def camera(entry: Mapping[str, Any], where: str, intrinsic: str = "intrinsic") -> dict[str, Any]:
    """Pose and intrinsics of an entry in the format of transforms.json.

    Args:
        entry: ``c2w`` and intrinsics, see `released_frames`.
        where: the entry, for messages.
        intrinsic: key of the intrinsics.

    Raises:
        InputError: names the entry and the key.
    """
    pose, K = matrix_of_numbers(entry.get("c2w")), matrix_of_numbers(entry.get(intrinsic))
    if pose.shape not in [(4, 4), (3, 4)]:
        raise InputError(f"{where}: c2w", "must be a 4x4 matrix of numbers")
    if K.shape != (3, 3):
        raise InputError(f"{where}: {intrinsic}", "must be a 3x3 matrix of numbers")
    if not np.abs(K[[0, 1, 2, 2, 2], [1, 0, 0, 1, 2]] - [0, 0, 0, 0, 1]).max() <= 1e-9:
        raise InputError(f"{where}: {intrinsic}", "must be that of a pinhole camera without skew")
    return {
        "transform_matrix": [*pose.tolist(), [0.0, 0.0, 0.0, 1.0]][:4],
        **{"fl_x": K[0, 0].item(), "fl_y": K[1, 1].item(), "cx": K[0, 2].item(), "cy": K[1, 2].item()},
    }


def check_pose(pose: np.ndarray, where: str) -> None:
    """Raise InputError if a pose (4, 4), camera to world, is no rigid motion or is further away than `MAX_POSITION`."""
    rotation = pose[:3, :3]
    if not np.abs(pose).max() <= MAX_POSITION:
        raise InputError(where, f"has entries that are not finite or exceed {MAX_POSITION:g} m")
    if np.abs(rotation @ rotation.T - np.eye(3)).max() > 1e-3 or np.linalg.det(rotation) < 0:
        raise InputError(where, "is not a rigid motion: its rotation is not orthonormal, or is mirrored")
    if np.abs(pose[3] - [0, 0, 0, 1]).max() > 1e-6:
        raise InputError(where, "is not a rigid motion: its last row must be 0, 0, 0, 1")


def image_name(entry: Any, where: str) -> str:
    """The ``file_path`` of an entry of a list of images. Raises InputError if it has none."""
    name = entry.get("file_path") if isinstance(entry, Mapping) else None
    if not is_path(name):
        raise InputError(where, "has no file_path that is a text", "Check that this is a list of images")
    return name


def is_path(name: Any) -> bool:
    """Whether a value of a list can be a path: a printable text without parts that are too long for a file system."""
    return (
        isinstance(name, str)
        and name.isprintable()
        and 0 < len(name) < 2000
        and all(len(part.encode()) < 250 for part in name.split("/"))
    )


def matrix_of_numbers(value: Any) -> np.ndarray:
    """Nested lists of numbers as float64; an empty array for anything else."""
    try:
        matrix = np.asarray(value)
        return matrix.astype(np.float64) if matrix.dtype.kind in "fiu" else np.empty(0)
    except (TypeError, ValueError, OverflowError, RecursionError):
        return np.empty(0)
