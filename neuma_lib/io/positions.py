"""Predicted positions of points in files of other programs: HDF5, npz, or a PLY for each frame."""

import io
import re
import zipfile
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from neuma_lib.errors import InputError
from neuma_lib.io.files import existing, reading, zip_member
from neuma_lib.io.hdf5 import read_arrays
from neuma_lib.io.ply import read_ply, write_ply

NAMES = ("tracers", "x")  # names of the array of positions, the preferred one first
MAX_BYTES = 2**31  # maximum size of an array [bytes]
MAX_DISTANCE = 100.0  # maximum coordinate of a point [m]. Larger ones are in other units.
_REMEDY = "Write an array x (T, N, 3) of positions in metres"


def write_points(path: str | Path, x: np.ndarray) -> None:
    """Write points (N, 3) as PLY."""
    write_ply(path, np.ascontiguousarray(x, "<f4").view([(axis, "<f4") for axis in "xyz"])[:, 0])


def read_positions(files: Sequence[str | Path]) -> tuple[np.ndarray, np.ndarray | None]:
    """Positions of points (T, N, 3) [m], float64, and the simulation steps of the frames (T,) if they are stated.

    Args:
        files: one ``.h5`` or ``.npz`` with an array ``tracers`` or ``x`` and optionally ``frames``; or ``.ply`` files,
            one per frame, which are sorted by the last number in their names; or a folder of them.

    Raises:
        InputError: missing or damaged files, no such array, another shape, or values that are not finite or not metres.
    """
    paths = [Path(file) for file in files]
    if len(paths) == 1 and paths[0].is_dir():
        paths = sorted(paths[0].glob("*.ply")) or [
            existing(paths[0] / "*.ply", "Put a .ply for each frame there")
        ]
    kinds = {path.suffix.lower() for path in paths}
    first = paths[0] if paths else Path("FILE")
    if kinds == {".ply"}:
        x, frames = _read_plys(paths), None
    elif len(paths) == 1 and kinds <= {".h5", ".hdf5", ".npz"}:
        arrays = _read_npz(first) if kinds == {".npz"} else read_arrays(first, only=(*NAMES, "frames"))[0]
        names = [name for name in NAMES if name in arrays]
        if not names:
            raise InputError(first, f"has no array {' or '.join(NAMES)}", _REMEDY)
        x, frames = arrays[names[0]], arrays.get("frames")
    else:
        problem = "positions must be one .h5 or .npz file, or .ply files alone"
        raise InputError(first, problem, "Give FILE again")
    if x.ndim != 3 or x.shape[2] != 3 or 0 in x.shape or x.dtype.kind not in "fiu":
        problem = f"positions of shape {x.shape} as {x.dtype} must be (T, N, 3) numbers"
        raise InputError(first, problem, _REMEDY)
    if frames is not None and (frames.shape != x.shape[:1] or frames.dtype.kind not in "iu"):
        problem = f"frames of shape {frames.shape} as {frames.dtype} must be {len(x)} integers"
        raise InputError(first, problem, "Write the simulation step of each frame, or leave them out")
    if not np.isfinite(x).all():
        frame, point = np.argwhere(~np.isfinite(x))[0][:2]
        problem = f"point {point} of frame {frame} is not finite"
        raise InputError(first, problem, "Repeat the last finite frame instead")
    if (size := float(np.abs(x).max())) > MAX_DISTANCE:
        raise InputError(first, f"a coordinate is {size:.3g} m, outside the unit cube by far", _REMEDY)
    return x.astype(np.float64), frames


def _read_npz(path: Path) -> dict[str, np.ndarray]:
    with reading(existing(path), "an archive of NumPy"), zipfile.ZipFile(path) as archive:
        members = {info.filename.removesuffix(".npy"): info for info in archive.infolist()}
        arrays = {}
        for name in (*NAMES, "frames"):
            if name in members:
                content = io.BytesIO(zip_member(archive, members[name], MAX_BYTES))
                arrays[name] = np.lib.format.read_array(content, allow_pickle=False)
        return arrays


def _read_plys(paths: Sequence[Path]) -> np.ndarray:
    """Vertices (T, N, 3) of a PLY per frame, in the order of their numbers."""
    numbers = [int((re.findall(r"\d+", path.stem) or ["-1"])[-1]) for path in paths]
    if len(paths) > 1 and (min(numbers) < 0 or len(set(numbers)) < len(numbers)):
        problem = "the names must end in different numbers of frames"
        raise InputError(paths[0], problem, "Use frame_000.ply, ...")
    frames: list[np.ndarray] = []
    for _, path in sorted(zip(numbers, paths, strict=True)):
        rows, _ = read_ply(path)
        if missing := [axis for axis in "xyz" if axis not in rows.dtype.names]:
            raise InputError(path, f"its vertices have no {', '.join(missing)}", "Write x, y and z in metres")
        frames.append(np.stack([rows[axis] for axis in "xyz"], axis=1))
        if len(frames[-1]) != len(frames[0]):
            problem = f"has {len(frames[-1])} points, the first frame has {len(frames[0])}"
            raise InputError(path, problem, "Write the same points in every frame")
    return np.stack(frames)
