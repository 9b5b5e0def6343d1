"""Records of bodies at rest: photographs with masks, one square marker in each, and one camera without distortion.

A folder has ``frames.json``, record -> ``frames``, a list of photographs: ``file``, ``mask`` (PNG, body above 127) and
``marker_corners_px`` (top left, top right, bottom right, bottom left). ``calibration.json`` has ``colour`` with ``fx``,
``fy``, ``cx``, ``cy`` [px] and ``marker`` with ``side_m``. Centres of first pixels are at (0, 0) in these files, and at
(0.5, 0.5) in this library.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from neuma_lib.errors import InputError
from neuma_lib.io.files import existing, read_json, reading

Array = NDArray[np.float64]

_CORNERS = np.array([[-0.5, 0.5, 0.0], [0.5, 0.5, 0.0], [0.5, -0.5, 0.0], [-0.5, -0.5, 0.0]])


@dataclass(frozen=True, eq=False)
class Still:
    """A photograph of a body at rest.

    Attributes:
        mask: of the body, shape (H, W).
        K: intrinsics, pixel centres at half integers, shape (3, 3) [px].
        marker: corners in the marker's frame, x right, y up, z towards the viewer, shape (M, 3) [m].
        marker_pixels: shape (M, 2) [px].
    """

    mask: NDArray[np.bool_]
    K: Array
    marker: Array
    marker_pixels: Array


def still_files(root: str | Path, record: str, key: str) -> list[str]:
    """Files of a record's photographs, ``key`` "file", or masks, "mask".

    Raises:
        InputError: the folder has no such record.
    """
    path = Path(root, "frames.json")
    records = read_json(existing(path, "Give the folder of the records as stills.root"))
    if not isinstance(records, dict) or record not in records:
        known = ", ".join(records) if isinstance(records, dict) else "none"
        raise InputError(path, f"has no record {record!r}", f"It has {known}")
    with reading(path, f"photographs of {record}"):
        return [str(Path(root, frame[key])) for frame in records[record]["frames"]]


def read_stills(root: str | Path, record: str) -> list[Still]:
    """All photographs of a record.

    Raises:
        InputError: a file is missing or damaged, or there is no such record.
    """
    masks = still_files(root, record, "mask")
    path = Path(root, "calibration.json")
    with reading(path, "a calibration"):
        values = read_json(existing(path))
        fx, fy, cx, cy = (float(values["colour"][key]) for key in ("fx", "fy", "cx", "cy"))
        marker = float(values["marker"]["side_m"]) * _CORNERS
    K = np.array([[fx, 0.0, cx + 0.5], [0.0, fy, cy + 0.5], [0.0, 0.0, 1.0]])
    stills = []
    for mask, frame in zip(masks, read_json(Path(root, "frames.json"))[record]["frames"], strict=True):
        with reading(Path(root, "frames.json"), f"marker corners of {record}"):
            corners = np.array(frame["marker_corners_px"], dtype=np.float64).reshape(4, 2)
        with reading(mask, "an image"), Image.open(existing(mask)) as image:
            stills.append(Still(np.asarray(image.convert("L")) > 127, K, marker, corners + 0.5))
    return stills
