"""Named quantities with units in HDF5: trajectories, sets of particles and sparse matrices."""

import json
import mmap
import re
import struct
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from neuma_lib.errors import InputError
from neuma_lib.io.files import atomic, existing, one_line, reading

QUANTITIES = {
    "x": ("m", "particle positions, shape (T, N, 3), or (N, 3) where there is one state"),
    "v": ("m/s", "particle velocities, shape (T, N, 3)"),
    "F": ("1", "elastic deformation gradients, shape (T, N, 3, 3), or (N, 3, 3) of single states"),
    "F_trial": ("1", "the same before the return map of a step, shape (N, 3, 3)"),
    "F_total": ("1", "total deformation gradients, plastic flow included, shape (T, N, 3, 3)"),
    "C": ("1/s", "APIC affine velocities, shape (T, N, 3, 3), or (S, P, 3, 3) of P particles at all S steps"),
    "frames": ("1", "simulation step of each frame, shape (T,)"),
    "time": ("s", "time of each frame, shape (T,)"),
    "vol0": ("m^3", "initial particle volumes, shape (N,)"),
    "mass": ("kg", "particle masses, shape (N,)"),
    "tracers": ("m", "positions of passive tracers, shape (T, M, 3)"),
    "tracers_again": ("m", "passive tracers of another sampling of the same body, shape (T, M, 3)"),
    "body": ("1", "index of the body of each particle, if several touch, shape (N,)"),
    "tracer_body": ("1", "index of the body of each passive tracer, if several touch, shape (M,)"),
    "starts": ("m", "start positions of passive tracers, shape (M, 3)"),
    "floor": ("1e-4 m^2", "Chamfer distances of two samplings of the true body at the frames, shape (T,)"),
    "indptr": ("1", "row starts of a sparse matrix, shape (rows + 1,)"),
    "indices": ("1", "columns of a sparse matrix, shape (entries,)"),
    "values": ("1", "entries of a sparse matrix, shape (entries,)"),
    "images": ("1", "pictures of a figure, colours 0 to 255, shape (rows, columns, H, W, 3)"),
}

INTEGERS = ("frames", "indptr", "indices", "body", "tracer_body")
"""Quantities that are indices or counts: integers that are not negative."""
_HEAP = b"GCOL\1\0\0\0"  # signature and version of a global heap
_MAX_ATTRIBUTE = 2**20  # maximum size of an attribute [bytes]


def write_arrays(
    path: str | Path, arrays: Mapping[str, Any], attributes: Mapping[str, Any] | None = None
) -> None:
    """Write named quantities (see `QUANTITIES`) to HDF5, each with its unit, and file attributes.

    Args:
        arrays: quantity name -> array; None entries are skipped.
        attributes: numbers and texts; anything else is stored as JSON text.
    """
    with atomic(path) as partial, h5py.File(partial, "w", track_order=True) as file:
        for name, array in arrays.items():
            if array is None:
                continue
            data = file.create_dataset(name, data=np.asarray(array), track_times=False)
            data.attrs["unit"], data.attrs["description"] = QUANTITIES[name]
        for key, value in (attributes or {}).items():
            file.attrs[key] = value if isinstance(value, str | int | float) else json.dumps(value)


def read_arrays(
    path: str | Path, required: Sequence[str] = (), only: Sequence[str] | None = None
) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    """Read quantities and attributes of an HDF5 artifact.

    Args:
        required: names that must exist.
        only: names to read; None reads all of `QUANTITIES` in the file.

    Raises:
        InputError: missing or damaged file, missing quantity, a group, link or text under its name, another shape than
            that of `QUANTITIES`, a value that is not finite, or a claimed size larger than the stored one.
    """
    path = existing(path)
    with reading(path, "HDF5"):
        _check_heaps(path)
    with reading(path, "HDF5"), h5py.File(path, "r") as file:
        if missing := [name for name in required if name not in file.keys()]:
            present = one_line(", ".join(file.keys()))
            raise InputError(path, f"has no dataset {', '.join(missing)} (it has {present})")
        # lookup by name would follow links
        names = [name for name in file.keys() if name in (QUANTITIES if only is None else only)]
        arrays = {name: _checked(file, name, path.stat().st_size)[()] for name in names}
        lengths: dict[str, int] = {}
        for name, array in arrays.items():
            _check_shape(name, array.shape, lengths)
            if array.dtype.kind == "f" and not np.isfinite(array).all():
                raise ValueError(f"{name} has values that are not finite")
            if name in INTEGERS:
                check_indices(name, array)
        return arrays, {key: _attribute(file, key) for key in file.attrs}


def _check_heaps(path: Path) -> None:
    """Check the heaps that hold the texts of attributes. HDF5 does not return from a free space of size 0 in them."""
    with open(path, "rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as content:
        start = content.find(_HEAP)
        while start >= 0:
            at, end = start + 16, start + struct.unpack_from("<Q", content, start + 8)[0]
            while at + 16 <= end:
                index, length = struct.unpack_from("<H6xQ", content, at)
                step = 16 + 8 * -(-length // 8) if index else length  # object 0 is free space with its header
                if step < 16 or at + step > end:
                    raise ValueError("a heap of texts is damaged")
                at += step
            start = content.find(_HEAP, start + 1)


def _checked(file: h5py.File, name: str, size: int) -> h5py.Dataset:
    """A dataset that is safe to read: numbers, all of them stored in this file of ``size`` bytes."""
    link = file.get(name, getlink=True)
    if not isinstance(link, h5py.HardLink):
        raise ValueError(f"{name} is a {type(link).__name__}, not a dataset of this file")
    data = file[name]
    numeric = isinstance(data, h5py.Dataset) and data.dtype.kind in "fiu" and not data.dtype.subdtype
    if not numeric or data.shape is None:
        raise ValueError(f"{name} is not an array of numbers")
    if data.is_virtual or data.external:
        raise ValueError(f"the values of {name} are in other files")
    if data.chunks:  # a filter may unpack any size, whatever the shape claims
        raise ValueError(f"{name} is stored in chunks or compressed, but these files are contiguous")
    stored = data.id.get_storage_size()
    if not data.nbytes <= stored <= size:
        raise ValueError(
            f"{name} claims {data.nbytes} bytes (shape {data.shape}) but stores {stored} in a file of {size}"
        )
    return data


def check_indices(name: str, array: np.ndarray, count: int | None = None) -> None:
    """Check indices from a file before a kernel uses them, because kernels do not check them.

    Args:
        name: of the array, for messages.
        array: any shape.
        count: number of elements that it refers to; None: not negative suffices.

    Raises:
        ValueError: no integers, or one that is negative or not below ``count``.
    """
    if array.dtype.kind not in "iu":
        raise ValueError(f"{name} must be integers, not {array.dtype}")
    end = np.iinfo(np.int64).max if count is None else count
    if array.size and not (0 <= array.min() and array.max() < end):
        raise ValueError(f"{name} has indices from {array.min()} to {array.max()}, expected 0 to {end - 1}")


def _check_shape(name: str, shape: tuple[int, ...], lengths: dict[str, int]) -> None:
    """Check a shape against the description in `QUANTITIES`; ``lengths`` are those of its letters so far."""
    if name not in QUANTITIES:
        return
    for expected in re.findall(r"\((.+?)\)", QUANTITIES[name][1].partition("shape ")[2]):
        letters = [letter.strip() for letter in expected.split(",") if letter]
        letters = [f"{name}.{letter}" if letter == "M" else letter for letter in letters]
        known = {letter: lengths.get(letter, int(letter) if letter.isdigit() else None) for letter in letters}
        if len(letters) == len(shape) and all(
            known[letter] in (None, length) for letter, length in zip(letters, shape)
        ):
            lengths.update(zip(letters, shape))
            return
    known = ", ".join(f"{letter} = {length}" for letter, length in lengths.items())
    raise ValueError(f"{name} has the shape {shape}, expected {QUANTITIES[name][1]}{known and f', {known}'}")


def _attribute(file: h5py.File, key: str) -> Any:
    """A number or a text attribute."""
    stored = file.attrs.get_id(key)
    small = stored.shape == () and stored.get_type().get_size() <= _MAX_ATTRIBUTE
    value = file.attrs[key] if small else None
    value = value.item() if isinstance(value, np.generic) else value
    if not isinstance(value, str | int | float):
        raise ValueError(f"attribute {one_line(key)} is not a number or a text")
    return value
