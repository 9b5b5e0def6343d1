"""Named quantities with units in HDF5: every trajectory, set of particles and sparse matrix."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from neuma_lib.errors import InputError
from neuma_lib.io.files import atomic, existing

QUANTITIES = {
    "x": ("m", "particle positions, shape (T, N, 3), or (N, 3) where there is one state"),
    "v": ("m/s", "particle velocities, shape (T, N, 3)"),
    "F": ("1", "elastic deformation gradients, shape (T, N, 3, 3)"),
    "F_total": ("1", "total deformation gradients, plastic flow included, shape (T, N, 3, 3)"),
    "C": ("1/s", "APIC affine velocities, shape (T, N, 3, 3)"),
    "frames": ("1", "simulation step of each frame, shape (T,)"),
    "time": ("s", "time of each frame, shape (T,)"),
    "vol0": ("m^3", "initial particle volumes, shape (N,)"),
    "mass": ("kg", "particle masses, shape (N,)"),
    "tracers": ("m", "positions of passive tracers, shape (T, M, 3)"),
    "tracers_again": ("m", "passive tracers of another sampling of the same body, shape (T, M, 3)"),
    "indptr": ("1", "row starts of a sparse matrix, shape (rows + 1,)"),
    "indices": ("1", "columns of a sparse matrix, shape (entries,)"),
    "values": ("1", "entries of a sparse matrix, shape (entries,)"),
    "images": ("1", "pictures of a figure, colours 0 to 255, shape (rows, columns, H, W, 3)"),
}


def write_arrays(
    path: str | Path, arrays: Mapping[str, Any], attributes: Mapping[str, Any] | None = None
) -> None:
    """Write named quantities (see `QUANTITIES`) to HDF5, each with its unit, and file attributes.

    Args:
        arrays: quantity name -> array; None entries are left out.
        attributes: numbers and texts; anything else is stored as JSON text.
    """
    import h5py

    with atomic(path) as partial, h5py.File(partial, "w", track_order=True) as file:
        for name, array in arrays.items():
            if array is None:
                continue
            unit, description = QUANTITIES[name]
            data = file.create_dataset(name, data=np.asarray(array), track_times=False)
            data.attrs["unit"] = unit
            data.attrs["description"] = description
        for key, value in (attributes or {}).items():
            file.attrs[key] = value if isinstance(value, str | int | float) else json.dumps(value)


def read_arrays(
    path: str | Path, required: Sequence[str] = (), only: Sequence[str] | None = None
) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    """Read quantities and attributes of an HDF5 artifact.

    Args:
        required: names that must be there.
        only: names to read (others stay on disk); None reads everything.

    Raises:
        InputError: missing or damaged file, missing quantity, or a value that is not finite.
    """
    import h5py

    path = existing(path)
    try:
        with h5py.File(path, "r") as file:
            missing = [name for name in required if name not in file]
            if missing:
                raise InputError(f"{path} has no dataset {', '.join(missing)} (it has {', '.join(file)})")
            arrays = {name: file[name][()] for name in file if only is None or name in only}
            attributes = dict(file.attrs.items())
    except OSError as error:
        raise InputError(
            f"{path} cannot be read as HDF5 ({error}): delete it and run the workflow again"
        ) from None
    for name, array in arrays.items():
        if array.dtype.kind == "f" and not np.isfinite(array).all():
            raise InputError(f"{path}: dataset {name} holds values that are not finite: make the file again")
    return arrays, {k: v.item() if isinstance(v, np.generic) else v for k, v in attributes.items()}
