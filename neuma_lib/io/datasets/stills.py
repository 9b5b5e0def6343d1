"""Records of bodies at rest: photographs with masks, one square marker in each, and one camera without distortion.

A folder has ``frames.json``, record -> ``frames``, a list of photographs: ``file``, ``mask`` (PNG, body above 127) and
``marker_corners_px`` (top left, top right, bottom right, bottom left). ``calibration.json`` has ``colour`` with ``fx``,
``fy``, ``cx``, ``cy`` [px] and ``marker`` with ``side_m``. Centres of first pixels are at (0, 0) in these files, and at
(0.5, 0.5) in this library.

A folder of a swing has ``times.json``, with ``figures``, number -> time [s], and ``label_NN.png`` for each of them: 255
body, 0 background, others unknown. They are pictures of the second camera of ``calibration.json``, ``depth``, with
``colour_to_depth_rotation`` and ``colour_to_depth_translation_m``.
"""

from dataclasses import dataclass, field
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
    """A photograph of a body at rest."""

    mask: NDArray[np.bool_]  # of the body, shape (H, W)
    K: Array  # intrinsics, pixel centres at half integers, shape (3, 3) [px]
    marker: Array  # corners in the marker's frame, x right, y up, z towards the viewer, shape (M, 3) [m]
    marker_pixels: Array  # shape (M, 2) [px]
    # from the frame of the first camera of the record to that of this one, shape (4, 4)
    camera: Array = field(default_factory=lambda: np.eye(4))
    # pixels that may show the body, shape (H, W). None: there are none.
    unknown: NDArray[np.bool_] | None = None


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
    """All photographs of a record. Raises InputError if a file or the record is missing or damaged."""
    masks = still_files(root, record, "mask")
    K = _intrinsics(root, "colour")
    path = Path(root, "calibration.json")
    with reading(path, "a calibration"):
        marker = float(read_json(path)["marker"]["side_m"]) * _CORNERS
    stills = []
    for mask, frame in zip(masks, read_json(Path(root, "frames.json"))[record]["frames"], strict=True):
        with reading(Path(root, "frames.json"), f"marker corners of {record}"):
            corners = np.array(frame["marker_corners_px"], dtype=np.float64).reshape(4, 2)
        with reading(mask, "an image"), Image.open(existing(mask)) as image:
            stills.append(Still(np.asarray(image.convert("L")) > 127, K, marker, corners + 0.5))
    return stills


def swing_files(root: str | Path, folder: str) -> dict[float, str]:
    """Label maps of a swing, by their times [s]. Raises InputError if there are none."""
    path = Path(root, folder, "times.json")
    with reading(path, "times of the label maps of a swing"):
        times = read_json(existing(path, "Give the folder of the records as stills.root"))["figures"]
        return {float(t): str(path.parent / f"label_{int(k):02d}.png") for k, t in times.items()}


def read_swing(root: str | Path, folder: str) -> dict[float, Still]:
    """Silhouettes of a swing by their times [s], without markers. Raises InputError if a file is missing or damaged."""
    K, path, camera = _intrinsics(root, "depth"), Path(root, "calibration.json"), np.eye(4)
    with reading(path, "the pose of the second camera"):
        values = read_json(path)
        camera[:3, :3] = values["colour_to_depth_rotation"]
        camera[:3, 3] = values["colour_to_depth_translation_m"]
    stills = {}
    for time, file in swing_files(root, folder).items():
        with reading(file, "an image"), Image.open(existing(file)) as image:
            labels = np.asarray(image.convert("L"))
        unknown = (labels > 0) & (labels < 255)
        stills[time] = Still(labels == 255, K, np.empty((0, 3)), np.empty((0, 2)), camera, unknown)
    return stills


def _intrinsics(root: str | Path, camera: str) -> Array:
    """K (3, 3) [px] of a camera of calibration.json."""
    path = Path(root, "calibration.json")
    with reading(path, "a calibration"):
        values = read_json(existing(path))
        fx, fy, cx, cy = (float(values[camera][key]) for key in ("fx", "fy", "cx", "cy"))
    return np.array([[fx, 0.0, cx + 0.5], [0.0, fy, cy + 0.5], [0.0, 0.0, 1.0]])
