"""Multi-view videos in the layouts of PAC-NeRF and Spring-Gaus (its synthetic scenes).

Frames are counted from 0, and the views at t = 0 are the frames 0 of all cameras. ``c2w`` is camera to world with
OpenGL axes, y is up. Positions x of their world become ``scale x + offset`` in ours.

- PAC-NeRF (github.com/xuan-li/PAC-NeRF): ``all_data.json``, a list of {``file_path``, ``c2w``, ``intrinsic``} over
  images ``r_<camera>_<frame>.png``. Frame -1 of a camera is the background without the object, frame -2 the mask of
  occluders. The authors' code writes matted images ``m_<camera>_<frame>.png`` on white into the same folder.
- Spring-Gaus (github.com/Colmar-zlicheng/Spring-Gaus): ``camera.json``, a list of {``camera``, ``c2w``, ``K``}, and for
  each camera a folder of that name with RGBA images ``000.png``, ``001.png``, ...
"""

import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from neuma_lib.errors import InputError
from neuma_lib.io.datasets.released import camera, image_name, is_path
from neuma_lib.io.files import atomic, read_json, read_regular, reading
from neuma_lib.io.images import (
    ImageSet,
    checked_transforms,
    open_image,
    read_image_set,
    relative_to,
    transform_world,
    write_transforms,
)

OFFSETS = {"all_data.json": (0.5, 0.0, 0.5), "camera.json": (0.0, -0.3, 0.0)}
"""List of a layout -> default offset of its world [m]: its ground at y = 0, its centre at that of the unit box."""
BACKGROUND, OCCLUDER = -1, -2  # frame numbers of PAC-NeRF's background images and occluder masks
OCCLUDED = 50  # minimum alpha of an occluder [1/255], as in the authors' code
BACKGROUND_DIFFERENCE = 24
"""Without a mask, the object is where a channel differs from the background by more than this [1/255]."""
BOX_MARGIN = 0.1  # allowed distance from the unit box of the point where all optical axes meet [m]
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
    """Write a transforms.json for frames of a video, and masked copies of the images that have no mask.

    Args:
        source: .../all_data.json or .../camera.json.
        target: the transforms.json; masked images are written to its folder.
        steps: simulation steps of the frames to take, multiples of ``stride``.
        stride: simulation steps per frame.
        scale: metres of our world per metre of theirs.
        offset: position of their scaled origin [m]; None: `OFFSETS`.

    Raises:
        InputError: names the file, and the wrong entry or the missing file.
    """
    source, target = Path(source), Path(target)
    read = _pac_nerf if source.name == "all_data.json" else _spring_gaus
    frames, backgrounds = read(source, [step // stride for step in steps])
    views = sorted({view for view, _ in frames})
    for view, number in frames:
        if not np.allclose(_pose(frames[view, number]), _pose(frames[view, steps[0] // stride]), atol=1e-6):
            raise InputError(f"{source}: camera {view}", f"moved by frame {number}, but must be static")
    target.parent.mkdir(parents=True, exist_ok=True)
    target.unlink(missing_ok=True)  # marks the folder as unfinished
    taken = []
    for step in steps:
        for view in views:
            frame = frames[view, step // stride]
            file = source.parent / frame["file_path"]
            pixels = _masked(file, backgrounds.get(view)) if backgrounds is not None else None
            if pixels is not None:
                file = target.parent / f"d_{view}_{step:04d}.png"
                with atomic(file) as partial:
                    Image.fromarray(pixels).save(partial, "PNG")
            taken.append({**frame, "file_path": relative_to(target, file), "view": view, "step": step})
    checked_transforms({"frames": taken}, source)
    offset = OFFSETS[source.name] if offset is None else offset
    world = transform_world(taken, scale, offset)
    _check_inside_box(taken, source)
    write_transforms(target, {}, taken, **world)
    return read_image_set(target)


def _pac_nerf(path: Path, numbers: Sequence[int]) -> tuple[Frames, dict[int, Path]]:
    """Frames by camera and number, and the background of each camera."""
    listed: Frames = {}
    backgrounds = {}
    for i, entry in enumerate(_entries(path)):
        name = image_name(entry, f"{path}: entry {i}")
        where = f"{path}: entry {i} ({name})"
        named = _NAME.fullmatch(Path(name).stem)
        if not named or int(named[2]) < OCCLUDER:
            problem = "must end in r_<camera>_<frame>.png with a frame number of at least -2"
            raise InputError(f"{where}: file_path", problem)
        view, number = int(named[1]), int(named[2])
        if number == BACKGROUND:
            backgrounds[view] = path.parent / name
        elif number == OCCLUDER:
            _refuse_occluder(path.parent / name)
        elif (view, number) in listed:
            raise InputError(f"{where}: file_path", "occurs in an earlier entry", "Remove one of them")
        else:
            listed[view, number] = {"file_path": name, **camera(entry, where)}
    chosen = {}
    for view in sorted({view for view, _ in listed}):
        for number in numbers:
            if (view, number) not in listed:
                raise _missing(path, f"lists no frame {number} of camera {view}")
            chosen[view, number] = listed[view, number]
            _existing_frame(path, chosen[view, number]["file_path"])
    if not chosen:
        raise InputError(path, "the list has no frames")
    return chosen, backgrounds


def _spring_gaus(path: Path, numbers: Sequence[int]) -> tuple[Frames, None]:
    """Frames by camera and number; the number of a camera is its index in the list."""
    frames: Frames = {}
    for view, entry in enumerate(_entries(path)):
        folder = entry.get("camera") if isinstance(entry, dict) else None
        if not is_path(folder):
            raise InputError(f"{path}: entry {view}: camera", "must be the name of a folder of images")
        pinhole = camera(entry, f"{path}: entry {view} ({folder})", intrinsic="K")
        for number in numbers:
            frames[view, number] = {"file_path": f"{folder}/{number:03d}.png", **pinhole}
            _existing_frame(path, frames[view, number]["file_path"])
    return frames, None


def _entries(path: Path) -> list[Any]:
    entries = read_json(path)
    if not isinstance(entries, list) or not entries:
        raise InputError(path, "must be a list with an entry for each image or camera")
    return entries


def _existing_frame(path: Path, name: str) -> None:
    if not (path.parent / name).is_file():
        raise _missing(path.parent / name, "does not exist")


def _missing(where: Path, problem: str) -> InputError:
    remedy = (
        "If the video ends earlier, reduce the scene's steps, or list the existing frames in its 'frames'"
    )
    return InputError(where, problem, remedy)


def _refuse_occluder(file: Path) -> None:
    with open_image(file.read_bytes() if file.is_file() else b"", file) as image, reading(file, "an image"):
        hidden = np.asarray(image.convert("RGBA"))[..., 3] > OCCLUDED
    if hidden.any():
        problem = f"an occluder covers {hidden.sum()} pixels, which the fits cannot exclude"
        raise InputError(file, problem, "Use a scene without occluders")


def _masked(file: Path, background: Path | None) -> np.ndarray | None:
    """RGBA (H, W, 4) of an image with the object's mask; None if the file has an alpha channel.

    The mask is everything but white in ``m_...``, or else the difference from the background.
    """
    pixels = _rgba(file)
    if (pixels[..., 3] < 255).any():
        return None
    matted = file.with_name("m" + file.name[file.name.index("_") :])
    if matted.is_file():
        inside = (_same_size(matted, pixels)[..., :3] < 255).any(axis=-1)
    elif background is not None:
        change = np.abs(pixels[..., :3].astype(int) - _same_size(background, pixels)[..., :3])
        inside = change.max(axis=-1) > BACKGROUND_DIFFERENCE
    else:
        raise InputError(
            file,
            "has no mask",
            f"Store it as alpha, add {matted.name} on white (as the authors' code does), or list a picture without "
            "the object as frame -1",
        )
    if not inside.any():
        raise InputError(file, "the mask is empty", "Skip this frame")
    pixels[..., 3] = np.where(inside, 255, 0)
    return pixels


def _rgba(file: Path) -> np.ndarray:
    if not file.is_file():
        raise InputError(file, "is listed but does not exist", "Add it, or remove it from the list")
    with open_image(read_regular(file), file) as image, reading(file, "an image"):
        return np.array(image.convert("RGBA"))


def _same_size(file: Path, pixels: np.ndarray) -> np.ndarray:
    other = _rgba(file)
    if other.shape != pixels.shape:
        height, width = pixels.shape[:2]
        raise InputError(file, f"is {other.shape[1]}x{other.shape[0]}, but the images are {width}x{height}")
    return other


def _pose(frame: dict[str, Any]) -> np.ndarray:
    return np.array(frame["transform_matrix"])


def _check_inside_box(frames: Sequence[dict[str, Any]], path: Path) -> None:
    """Check that the point nearest to all optical axes, if it is unique, lies in the unit box."""
    poses = np.unique([_pose(frame) for frame in frames], axis=0)
    away = np.eye(3) - np.einsum("ni,nj->nij", poses[:, :3, 2], poses[:, :3, 2])
    if np.linalg.cond(away.sum(axis=0)) > 1e3:  # one camera, or parallel ones
        return
    point = np.linalg.solve(away.sum(axis=0), np.einsum("nij,nj->i", away, poses[:, :3, 3]))
    if (point < -BOX_MARGIN).any() or (point > 1 + BOX_MARGIN).any():
        raise InputError(
            path,
            f"the optical axes meet at ({', '.join(f'{x:.2f}' for x in point)}) m, outside the simulator's unit cube",
            "Set images.offset and images.scale of the scene so that the object lies inside and its ground at y = 0",
        )
