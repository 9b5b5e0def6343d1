"""Pictures of a figure in rows and columns, with the numbers that stand beside them: the data file of a figure."""

from __future__ import annotations

import json
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from neuma_lib.errors import InputError
from neuma_lib.io.hdf5 import read_arrays, write_arrays


@dataclass(frozen=True)
class Panels:
    """Pictures of one size.

    Attributes:
        images: colours 0 to 255, uint8, shape (R, C, H, W, 3).
        rows: R titles.
        columns: C titles.
        numbers: whatever else the figure shows: plain numbers, lists and texts by name.
    """

    images: np.ndarray
    rows: tuple[str, ...]
    columns: tuple[str, ...]
    numbers: dict[str, Any] = field(default_factory=dict)

    def __post_init__(self):
        expected = (len(self.rows), len(self.columns))
        if self.images.ndim != 5 or self.images.shape[:2] != expected or self.images.dtype != np.uint8:
            raise InputError(
                f"panels: {self.images.dtype} pictures of shape {self.images.shape} for {expected} titles; expected"
                " uint8 (rows, columns, H, W, 3)"
            )


def save_panels(path: str | Path, panels: Panels) -> None:
    """Write panels to HDF5."""
    text = {name: json.dumps(getattr(panels, name)) for name in ("rows", "columns", "numbers")}
    write_arrays(path, {"images": panels.images}, text)


def load_panels(path: str | Path) -> Panels:
    """Read panels. Raises InputError when the file is no data file of a figure."""
    arrays, attributes = read_arrays(path, required=("images",))
    missing = [name for name in ("rows", "columns", "numbers") if name not in attributes]
    if missing:
        raise InputError(f"{path} has no {', '.join(missing)}: it is not the data of a figure; make it again")
    rows, columns, numbers = (json.loads(attributes[name]) for name in ("rows", "columns", "numbers"))
    return Panels(arrays["images"], tuple(rows), tuple(columns), numbers)
