"""Videos of several cameras as PAC-NeRF and Spring-Gaus (its synthetic scenes) lay them out, taken as they are.

Frames are counted from 0, and the views at t = 0 are the frames 0 of all cameras. ``c2w`` is camera to world with
OpenGL axes, y is up. Positions x of their world become ``scale x + offset`` in ours.

- PAC-NeRF (github.com/xuan-li/PAC-NeRF): ``all_data.json``, a list of {``file_path``, ``c2w``, ``intrinsic``} over
  images ``r_<camera>_<frame>.png``. Frame -1 is the camera's picture without the object, frame -2 the mask of what
  stands in front of it. Its code leaves matted images ``m_<camera>_<frame>.png`` on white beside them.
- Spring-Gaus (github.com/Colmar-zlicheng/Spring-Gaus): ``camera.json``, a list of {``camera``, ``c2w``, ``K``}, and for
  each camera a folder of that name with RGBA images ``000.png``, ``001.png``, ...
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from neuma_lib.errors import InputError
from neuma_lib.io.files import atomic, read_json, reading
from neuma_lib.io.images import (
    ImageSet,
    checked_transforms,
    open_image,
    place,
    read_image_set,
    relative_to,
    write_transforms,
)
from neuma_lib.io.released import camera, image_name

OFFSETS = {"all_data.json": (0.5, 0.0, 0.5), "camera.json": (0.0, -0.3, 0.0)}
"""List of a layout -> where the origin of its world is put [m]: its ground on y = 0, its middle in that of the box."""
PLATE, OCCLUDER = -1, -2
"""Numbers of PAC-NeRF's frames without the object, and of what stands in front of it."""
OCCLUDED = 50
"""Least alpha of an occluder [1/255], as in the authors' code."""
PLATE_DIFFERENCE = 24
"""Where no mask is at hand, the object is what differs from the plate by more, in any channel [1/255]."""
BOX_MARGIN = 0.1
"""How far outside the box the point may lie that all cameras look at [m]."""
_NAME = re.compile(r"[a-z]+_(\d{1,9})_(-?\d{1,9})", re.IGNORECASE)

Frames = dict[tuple[int, int], dict[str, Any]]


def take_video(
    source: str | Path,
    target: str | Path,
    steps: Sequence[int],
    stride: int,
    scale: float = 1.0,
    offset: Sequence[float] | None = None,
) -> ImageSet:
    """Write a transforms.json for frames of a video; images with a mask stay where they are, others get one.

    Args:
        source: .../all_data.json or .../camera.json.
        target: the transforms.json; masked images are written beside it.
        steps: simulation steps of the frames to take, multiples of ``stride``.
        stride: steps from frame to frame.
        scale: metres of ours to a metre of theirs.
        offset: where their scaled origin is [m]; None: `OFFSETS`.

    Raises:
        InputError: names the file, and the entry and key or what is missing.
    """
    source, target = Path(source), Path(target)
    read = _pac_nerf if source.name == "all_data.json" else _spring_gaus
    frames, plates = read(source, [step // stride for step in steps])
    views = sorted({view for view, _ in frames})
    for view, number in frames:
        if not np.allclose(_pose(frames[view, number]), _pose(frames[view, steps[0] // stride]), atol=1e-6):
            raise InputError(f"{source}: camera {view} has moved by frame {number}; cameras must stand still")
    target.parent.mkdir(parents=True, exist_ok=True)
    target.unlink(missing_ok=True)  # a folder without it is an unfinished one
    taken = []
    for step in steps:
        for view in views:
            frame = frames[view, step // stride]
            file = source.parent / frame["file_path"]
            pixels = _masked(file, plates.get(view)) if plates is not None else None
            if pixels is not None:
                file = target.parent / f"d_{view}_{step:04d}.png"
                with atomic(file) as partial:
                    Image.fromarray(pixels).save(partial, "PNG")
            taken.append({**frame, "file_path": relative_to(target, file), "view": view, "step": step})
    checked_transforms({"frames": taken}, source)
    offset = OFFSETS[source.name] if offset is None else offset
    world = place(taken, scale, offset)
    _check_placed(taken, source)
    write_transforms(target, {}, taken, **world)
    return read_image_set(target)


def _pac_nerf(path: Path, numbers: Sequence[int]) -> tuple[Frames, dict[int, Path]]:
    """Frames by camera and number, and the plate of each camera."""
    found: Frames = {}
    plates = {}
    for i, entry in enumerate(_entries(path)):
        name = image_name(entry, f"{path}: entry {i}")
        where = f"{path}: entry {i} ({name})"
        named = _NAME.fullmatch(Path(name).stem)
        if not named or int(named[2]) < OCCLUDER:
            raise InputError(
                f"{where}: file_path must end in r_<camera>_<frame>.png, with a frame of -2 or more"
            )
        view, number = int(named[1]), int(named[2])
        if number == PLATE:
            plates[view] = path.parent / name
        elif number == OCCLUDER:
            _refuse_occluder(path.parent / name)
        elif (view, number) in found:
            raise InputError(f"{where}: file_path is that of an earlier entry; remove one of them")
        else:
            found[view, number] = {"file_path": name, **camera(entry, where)}
    chosen = {}
    for view in sorted({view for view, _ in found}):
        for number in numbers:
            if (view, number) not in found:
                raise InputError(_missing(f"{path} lists no frame {number} of camera {view}"))
            chosen[view, number] = found[view, number]
            _existing_frame(path, chosen[view, number]["file_path"])
    if not chosen:
        raise InputError(f"{path}: the list has no frames")
    return chosen, plates


def _spring_gaus(path: Path, numbers: Sequence[int]) -> tuple[Frames, None]:
    """Frames by camera and number; a camera's number is its place in the list."""
    frames: Frames = {}
    for view, entry in enumerate(_entries(path)):
        folder = entry.get("camera") if isinstance(entry, dict) else None
        if not isinstance(folder, str) or not folder or not folder.isprintable():
            raise InputError(f"{path}: entry {view}: camera must be the name of a folder of images")
        pinhole = camera(entry, f"{path}: entry {view} ({folder})", intrinsic="K")
        for number in numbers:
            frames[view, number] = {"file_path": f"{folder}/{number:03d}.png", **pinhole}
            _existing_frame(path, frames[view, number]["file_path"])
    return frames, None


def _entries(path: Path) -> list[Any]:
    entries = read_json(path)
    if not isinstance(entries, list) or not entries:
        raise InputError(f"{path}: expected a list with an entry for each image or camera")
    return entries


def _existing_frame(path: Path, name: str) -> None:
    if not (path.parent / name).is_file():
        raise InputError(_missing(f"{path.parent / name} is missing"))


def _missing(what: str) -> str:
    return f"{what}: where the video ends earlier, lower the scene's steps, or list in its 'frames' those that exist"


def _refuse_occluder(file: Path) -> None:
    with open_image(file.read_bytes() if file.is_file() else b"", file) as image, reading(file, "an image"):
        hidden = np.asarray(image.convert("RGBA"))[..., 3] > OCCLUDED
    if hidden.any():
        raise InputError(
            f"{file} says that something stands in front of the object in {hidden.sum()} pixels, which cannot be left "
            "out of the fits: take a scene without occluders"
        )


def _masked(file: Path, plate: Path | None) -> np.ndarray | None:
    """RGBA (H, W, 4) of an image with the object's mask; None where the file has one itself.

    The mask is what the authors' code has left, everything but white in ``m_...``; else the difference from the plate.
    """
    pixels = _rgba(file)
    if (pixels[..., 3] < 255).any():
        return None
    matted = file.with_name("m" + file.name[file.name.index("_") :])
    if matted.is_file():
        inside = (_same_size(matted, pixels)[..., :3] < 255).any(axis=-1)
    elif plate is not None:
        change = np.abs(pixels[..., :3].astype(int) - _same_size(plate, pixels)[..., :3])
        inside = change.max(axis=-1) > PLATE_DIFFERENCE
    else:
        raise InputError(
            f"{file} has no mask: store it as alpha, add {matted.name} on white beside it (the authors' code does), or "
            "list a picture without the object as frame -1"
        )
    if not inside.any():
        raise InputError(f"{file}: the mask is empty, nothing is in the picture: leave this frame out")
    pixels[..., 3] = np.where(inside, 255, 0)
    return pixels


def _rgba(file: Path) -> np.ndarray:
    if not file.is_file():
        raise InputError(f"{file} is missing although it is listed: add it, or remove it from the list")
    with open_image(file.read_bytes(), file) as image, reading(file, "an image"):
        return np.array(image.convert("RGBA"))


def _same_size(file: Path, pixels: np.ndarray) -> np.ndarray:
    other = _rgba(file)
    if other.shape != pixels.shape:
        height, width = pixels.shape[:2]
        raise InputError(f"{file} is {other.shape[1]}x{other.shape[0]}, the images are {width}x{height}")
    return other


def _pose(frame: dict[str, Any]) -> np.ndarray:
    return np.array(frame["transform_matrix"])


def _check_placed(frames: Sequence[dict[str, Any]], path: Path) -> None:
    """The point nearest to all optical axes lies in the box, if there is one such point."""
    poses = np.unique([_pose(frame) for frame in frames], axis=0)
    away = np.eye(3) - np.einsum("ni,nj->nij", poses[:, :3, 2], poses[:, :3, 2])
    if np.linalg.cond(away.sum(axis=0)) > 1e3:  # one camera, or parallel ones
        return
    point = np.linalg.solve(away.sum(axis=0), np.einsum("nij,nj->i", away, poses[:, :3, 3]))
    if (point < -BOX_MARGIN).any() or (point > 1 + BOX_MARGIN).any():
        there = ", ".join(f"{x:.2f}" for x in point)
        raise InputError(
            f"{path}: the cameras look at ({there}) m, outside the simulator's box, the unit cube: set "
            "images.offset and images.scale of the scene so that the object is in it and its ground on y = 0"
        )
