"""Read and write mattes: pictures with masks, listed in a transforms.json."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from neuma_lib.capture.calibration.lens import Lens
from neuma_lib.capture.masks.regions import matted, read_mask
from neuma_lib.capture.pictures import undistorted, write_png
from neuma_lib.errors import InputError
from neuma_lib.io.images import OPENGL_TO_OPENCV, image_file, read_rgba, read_transforms, write_transforms


def room_frames(path: str | Path, group: str) -> list[dict[str, Any]]:
    """Entries of the room's transforms.json of `photographs` or a camera. Raises InputError if there are none."""
    frames = [frame for frame in read_transforms(path)["frames"] if frame.get("group") == group]
    if not frames:
        raise InputError(
            path, f"no pose was estimated for the pictures of '{group}'", "See the report of the poses"
        )
    return frames


def own_mask(
    path: str | Path, lens: Lens, longest: int, labels: Mapping[str, int | str] | None = None
) -> np.ndarray:
    """A mask of the user, undistorted like its picture, (H, W), with numbers of bodies if there are labels.

    Raises InputError as `read_mask`.
    """
    mask = read_mask(path, (lens.width, lens.height), labels)
    numbers = range(1, 1 + len(labels or [""]))
    shares = [undistorted(255 * (mask == k).astype(np.uint8), lens, longest) for k in numbers]
    return numbered(np.stack(shares)) if labels else shares[0] > 127


def numbered(shares: np.ndarray) -> np.ndarray:
    """Number, from 1, of the body with the largest share of each pixel, where all cover more than half of it, else 0.

    Args:
        shares: of each body, (bodies, H, W), 0 to 255.
    """
    covered = shares.sum(axis=0, dtype=np.float32) > 127
    return np.where(covered, 1 + shares.argmax(axis=0), 0).astype(np.uint8)


def metric_camera(frame: Mapping[str, Any], world: Mapping[str, Any]) -> tuple[np.ndarray, np.ndarray]:
    """Camera of an entry in the room's metres, before placement into the simulation box.

    Args:
        world: ``world`` of the file, with scale and offset.

    Returns:
        World to camera, OpenCV axes (4, 4), and intrinsics (3, 3) [px].
    """
    pose = np.array(frame["transform_matrix"], np.float64)
    pose[:3, 3] = (pose[:3, 3] - world.get("offset", 0.0)) / world.get("scale", 1.0)
    K = np.array([[frame["fl_x"], 0, frame["cx"]], [0, frame["fl_y"], frame["cy"]], [0, 0, 1]], np.float64)
    return np.linalg.inv(pose @ OPENGL_TO_OPENCV), K


def world_of(room: str | Path) -> dict[str, Any]:
    """Entries of the room's transforms.json that describe its world, shared by all files derived from it."""
    data = read_transforms(room)
    return {key: data[key] for key in ("world", "room") if key in data}


class Mattes(Sequence[np.ndarray]):
    """Mattes of a transforms.json, straight-alpha RGBA (H, W, 4), uint8, each read when it is used."""

    def __init__(self, path: str | Path):
        self._path, self.frames = path, read_transforms(path)["frames"]

    def __len__(self) -> int:
        return len(self.frames)

    def __getitem__(self, i: int) -> np.ndarray:
        frame = self.frames[i]
        file = image_file(Path(self._path).parent, frame["file_path"], self._path)
        size = (frame["w"], frame["h"]) if "w" in frame else None
        return read_rgba(file, frame.get("sha256"), size)


def write_labels(folder: Path, name: str, labels: np.ndarray) -> str:
    """Write the numbers of bodies (H, W) in a picture of a name, and return their ``label_path`` in a list."""
    (folder / "labels").mkdir(exist_ok=True)
    write_png(folder / "labels" / name, labels)
    return f"labels/{name}"


def write_mattes(
    path: str | Path,
    mattes: Iterable[tuple[dict[str, Any], np.ndarray, np.ndarray]],
    world: Mapping[str, Any],
    body: int | None = None,
) -> None:
    """Write a transforms.json and the RGBA pictures that it lists.

    Args:
        path: .../transforms.json.
        mattes: entry with the ``file_path`` to write to, pixels (H, W, 3), uint8, and mask (H, W) of each picture. A
            mask with numbers of bodies is written as well (`neuma_lib.io.images.read_labels`).
        world: entries of the file that describe the world of its cameras, see `world_of`.
        body: number of the body that the pictures show (`neuma_lib.io.images.read_hidden`). None: all.
    """
    folder = Path(path).parent
    folder.mkdir(parents=True, exist_ok=True)
    Path(path).unlink(missing_ok=True)  # a folder without it is incomplete
    frames = []
    for frame, pixels, mask in mattes:
        rgba = matted(pixels, mask == body if body else mask > 0)
        rgba[rgba[..., 3] == 0] = 0  # compresses better
        write_png(folder / frame["file_path"], rgba)
        if mask.dtype != bool:
            frame = {**frame, "label_path": write_labels(folder, frame["file_path"], mask)}
        frames.append({key: value for key, value in frame.items() if key != "sha256"})
    write_transforms(path, {}, frames, **world, **({"body": body} if body else {}))
