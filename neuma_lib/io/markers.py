"""Tracks of markers in CSV files of motion capture."""

import csv
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from neuma_lib.coupling.markers import MarkerTracks
from neuma_lib.errors import InputError
from neuma_lib.io.files import existing

TIME = "t_s"
UNITS = {"m": 1.0, "mm": 1e-3}


def read_markers(path: str | Path, names: Sequence[str]) -> MarkerTracks:
    """Tracks of some markers from a file with the column `TIME` [s] and, for each marker, ``<name>_<axis>_<unit>``
    with the axes x, y and z and the unit m or mm.

    Raises:
        InputError: the file or a column is missing, or a value is no number.
    """
    path = existing(path)
    with open(path, newline="") as file:
        header, *rows = csv.reader(file)
    try:
        table = np.array([[float(value) for value in row] for row in rows if row])
    except ValueError as error:
        problem = f"a value is no number: {error}"
        raise InputError(path, problem, "Fill or cut the gaps of the record") from None
    unit = next((unit for unit in UNITS if f"{names[0]}_x_{unit}" in header), "m")
    columns = [f"{name}_{axis}_{unit}" for name in names for axis in "xyz"]
    if missing := [name for name in (TIME, *columns) if name not in header]:
        raise InputError(path, f"has no column {missing[0]}. Its columns are {', '.join(header)}")
    positions = table[:, [header.index(name) for name in columns]].reshape(len(table), len(names), 3)
    return MarkerTracks(table[:, header.index(TIME)], UNITS[unit] * positions)
