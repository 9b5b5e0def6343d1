"""A throw's video as it was filmed, at the size of the report: frames, mattes, the empty scene."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from neuma_lib.capture.clock import reduced, reduced_intrinsics
from neuma_lib.capture.plate import match_exposure
from neuma_lib.errors import InputError
from neuma_lib.io.files import atomic
from neuma_lib.io.images import open_image, read_transforms


def shown_frames(
    folder: Path,
    camera: str,
    video: Sequence[Mapping[str, Any]],
    mattes: str | Path,
    frames: Iterable[tuple[int, np.ndarray]],
    plate: np.ndarray,
    width: int,
    gain: Sequence[float],
) -> list[dict[str, Any]]:
    """Write the frames of one camera that a law is judged by, with their mattes and the empty scene.

    Args:
        folder: where to.
        camera: its name.
        video: entries of the video on the simulator's clock.
        mattes: transforms.json of the camera's mattes.
        frames: number and undistorted picture (H, W, 3), uint8, of each of these frames.
        plate: the empty scene, (H, W, 3), uint8.
        width: longer side of what is written [px].
        gain: of the camera against the photographs, (3,).

    Returns:
        An entry of a transforms.json for each frame: ``picture`` and ``plate`` beside the matte, and the picture's
        exposure against the plate.

    Raises:
        InputError: frames of another size than the empty scene.
    """
    filmed = {entry["frame"]: entry for entry in video if entry["camera"] == camera}
    listing = {frame["step"]: frame for frame in read_transforms(mattes)["frames"]}
    entries, small_plate = [], None
    for number, pixels in frames:
        source = listing[number]
        place = Path(mattes).parent / source["file_path"]
        with open_image(place.read_bytes(), place, source.get("sha256")) as image:
            matte = reduced(np.asarray(image.convert("RGBA")), width)
        if pixels.shape != plate.shape:
            raise InputError(f"{mattes}: frames of {camera} are not of the size of its empty picture")
        size = matte.shape[1::-1]
        picture, empty = (
            np.asarray(Image.fromarray(p).resize(size, Image.Resampling.BOX)) for p in (pixels, plate)
        )
        if small_plate is None:
            small_plate = _save(folder, f"{camera}.png", empty)
        exposure, offset = match_exposure(picture, empty)
        stem = f"{camera}_{number:05d}"
        entries.append(
            {
                **filmed[number],
                **reduced_intrinsics(source, size),
                "file_path": _save(folder, f"{stem}_matte.png", matte),
                "picture": _save(folder, f"{stem}.png", picture),
                "plate": small_plate,
                "plate_gain": exposure.tolist(),
                "plate_offset": offset.tolist(),
                "gain": list(gain),
            }
        )
    return entries


def numbers_of(video: Sequence[Mapping[str, Any]], camera: str) -> list[int]:
    """Numbers of a camera's frames in a video on the simulator's clock."""
    return [entry["frame"] for entry in video if entry["camera"] == camera]


def _save(folder: Path, name: str, pixels: np.ndarray) -> str:
    with atomic(folder / name) as partial:
        Image.fromarray(pixels).save(partial, "PNG")
    return name
