"""Video of a take for display in the report: original frames, mattes and background at reduced size."""

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from neuma_lib.capture.masks.background import match_exposure
from neuma_lib.capture.motion.synchronisation import reduced, reduced_intrinsics
from neuma_lib.capture.pictures import write_png
from neuma_lib.errors import InputError
from neuma_lib.io.files import read_regular
from neuma_lib.io.images import open_image, read_transforms


def display_frames(
    folder: Path,
    camera: str,
    video: Sequence[Mapping[str, Any]],
    mattes: str | Path,
    frames: Iterable[tuple[int, np.ndarray]],
    background: np.ndarray,
    width: int,
    gain: Sequence[float],
) -> list[dict[str, Any]]:
    """Write the evaluated frames of one camera, with their mattes and the background.

    Args:
        folder: output folder.
        camera: its name.
        video: entries of the video in simulation time.
        mattes: transforms.json of the camera's mattes.
        frames: number and undistorted picture (H, W, 3), uint8, of each of these frames.
        background: the empty scene, (H, W, 3), uint8.
        width: longer side of the output [px].
        gain: of the camera relative to the photographs, (3,).

    Returns:
        An entry of a transforms.json for each frame, with the files ``picture`` and ``plate`` (background) and the
        exposure of the picture relative to the background.

    Raises:
        InputError: frames and background differ in size.
    """
    filmed = {entry["frame"]: entry for entry in video if entry["camera"] == camera}
    listing = {frame["step"]: frame for frame in read_transforms(mattes)["frames"]}
    entries, background_file = [], None
    for number, pixels in frames:
        source = listing[number]
        place = Path(mattes).parent / source["file_path"]
        with open_image(read_regular(place), place, source.get("sha256")) as image:
            matte = reduced(np.asarray(image.convert("RGBA")), width)
        if pixels.shape != background.shape:
            raise InputError(
                mattes,
                f"frames of {camera} have {pixels.shape[1]}x{pixels.shape[0]} pixels, its empty picture"
                f" {background.shape[1]}x{background.shape[0]}",
            )
        size = matte.shape[1::-1]
        picture, empty = (
            np.asarray(Image.fromarray(p).resize(size, Image.Resampling.BOX)) for p in (pixels, background)
        )
        if background_file is None:
            background_file = _save(folder, f"{camera}.png", empty)
        exposure, offset = match_exposure(picture, empty)
        stem = f"{camera}_{number:05d}"
        entries.append(
            {
                **filmed[number],
                **reduced_intrinsics(source, size),
                "file_path": _save(folder, f"{stem}_matte.png", matte),
                "picture": _save(folder, f"{stem}.png", picture),
                "plate": background_file,
                "plate_gain": exposure.tolist(),
                "plate_offset": offset.tolist(),
                "gain": list(gain),
            }
        )
    return entries


def numbers_of(video: Sequence[Mapping[str, Any]], camera: str) -> list[int]:
    """Numbers of a camera's frames in a video in simulation time."""
    return [entry["frame"] for entry in video if entry["camera"] == camera]


def _save(folder: Path, name: str, pixels: np.ndarray) -> str:
    write_png(folder / name, pixels)
    return name
