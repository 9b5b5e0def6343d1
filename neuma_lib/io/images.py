"""Calibrated images: transforms.json and the files that it lists."""

from __future__ import annotations

import hashlib
import math
import os
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
import torch
from PIL import Image

from neuma_lib.errors import InputError
from neuma_lib.io.files import one_line, read_json, reading, sha256_file, write_json
from neuma_lib.io.released import image_name, matrix_of_numbers, released_frames
from neuma_lib.splatting.cameras import Cameras
from neuma_lib.splatting.observation import Observation, exposed_steps


@dataclass(frozen=True)
class ImageSet:
    """Calibrated images: one entry a file, in the order of transforms.json.

    Attributes:
        images: straight-alpha RGBA, uint8, shape (K, H, W, 4).
        viewmats: world to camera, OpenCV axes, shape (K, 4, 4).
        Ks: intrinsics [px], pixel centres at +0.5, shape (K, 3, 3).
        views: camera number of each image, shape (K,).
        steps: simulation step of each image, shape (K,).
    """

    images: np.ndarray
    viewmats: np.ndarray
    Ks: np.ndarray
    views: np.ndarray
    steps: np.ndarray

    @property
    def width(self) -> int:
        return self.images.shape[2]

    @property
    def height(self) -> int:
        return self.images.shape[1]

    def video(self, views: Sequence[int]) -> tuple[tuple[int, ...], np.ndarray, np.ndarray]:
        """Frames of some views: steps, indices into the images of shape (T, V), and camera indices of shape (V,).

        Raises:
            InputError: a view is missing, or the views were not filmed at the same steps.
        """
        columns = []
        for view in views:
            chosen = np.flatnonzero(self.views == view)
            if len(chosen) == 0:
                filmed = sorted(set(self.views.tolist()))
                raise InputError(f"view {view} is not among the filmed views {filmed}")
            columns.append(chosen[np.argsort(self.steps[chosen], kind="stable")])
        steps = [tuple(self.steps[c].tolist()) for c in columns]
        if any(s != steps[0] for s in steps):
            raise InputError(f"views {list(views)} were not filmed at the same steps")
        index = np.stack(columns, axis=1)
        return steps[0], index, index[0]


FORMATS = ("PNG", "JPEG", "WEBP")
"""Image formats that are read, by Pillow's names; others have decoders that are less tried."""
MAX_PIXELS = 2**26
"""Most pixels of an image that is read: 8192 x 8192, 256 MiB of RGBA."""
SUB_FRAMES = 5
"""Most renders that are averaged to a frame, where settings say nothing else."""
OPENGL_TO_OPENCV = np.diag([1.0, -1.0, -1.0, 1.0])


def write_transforms(
    path: str | Path, intrinsics: Mapping[str, float], frames: Sequence[Mapping[str, Any]], **extra: Any
) -> None:
    """Write transforms.json beside images that exist already; the sha256 of each image is added.

    Args:
        path: .../transforms.json.
        intrinsics: fl_x, fl_y, cx, cy [px], w, h.
        frames: dicts with ``file_path`` relative to the folder, ``transform_matrix`` (camera to world, OpenGL
            axes, 4 x 4) and what else is known of a frame (``view``, ``step``, ``time``).
        extra: further top-level entries.
    """
    folder = Path(path).parent
    entries = [{**frame, "sha256": sha256_file(folder / frame["file_path"])} for frame in frames]
    write_json(path, {**intrinsics, **extra, "frames": entries})


def list_images(
    source: str | Path, path: str | Path, scale: float = 1.0, offset: Sequence[float] | None = None
) -> ImageSet:
    """Write a transforms.json for images that stay where another list names them; returns what it lists.

    Args:
        source: a transforms.json, or a list in the layout of the authors' release.
        path: the new transforms.json.
        scale, offset: as of `place`; None: no offset.

    Raises:
        InputError: as of `read_image_set`.
    """
    images = read_image_set(source)
    data = read_transforms(source)
    files = [image_file(Path(source).parent, frame["file_path"], source) for frame in data["frames"]]
    Path(path).parent.mkdir(parents=True, exist_ok=True)
    names = [relative_to(path, file) for file in files]
    frames = [{**f, "file_path": name} for f, name in zip(data.pop("frames"), names, strict=True)]
    world = place(frames, scale, (0.0, 0.0, 0.0) if offset is None else offset)
    write_transforms(path, data, frames, **world)
    return read_image_set(path) if world else images


def relative_to(path: str | Path, file: Path) -> str:
    """The name of a file in a list at ``path``."""
    return os.path.relpath(file.resolve(), Path(path).parent.resolve())


def place(frames: Sequence[dict[str, Any]], scale: float, offset: Sequence[float]) -> dict[str, Any]:
    """Move cameras in place, positions x to ``scale x + offset`` [m].

    Returns:
        What a transforms.json says of it: ``world`` with ``scale`` and ``offset``; nothing if nothing moved.
    """
    if scale == 1.0 and not any(offset):
        return {}
    for frame in frames:
        pose = np.array(frame["transform_matrix"], dtype=np.float64)
        pose[:3, 3] = scale * pose[:3, 3] + offset
        frame["transform_matrix"] = pose.tolist()
    return {"world": {"scale": scale, "offset": [float(x) for x in offset]}}


def read_transforms(path: str | Path) -> dict[str, Any]:
    """Read and check transforms.json: for every frame a file, a pose, and intrinsics (its own or the file's).

    A list in the layout of the authors' release is read as well (`neuma_lib.io.released`).

    Raises:
        InputError: names the file, the frame and the missing or wrong entry.
    """
    return checked_transforms(read_json(path), path)


def checked_transforms(data: Any, path: str | Path) -> dict[str, Any]:
    """What a transforms.json holds, if it is one (see `read_transforms`); ``path`` is for messages."""
    if isinstance(data, list):
        data = {"frames": released_frames(data, path)}
    frames = data.get("frames") if isinstance(data, dict) else None
    if not isinstance(frames, list) or not frames:
        raise InputError(f"{path}: the list 'frames' is missing or empty")
    for i, frame in enumerate(frames):
        where = f"{path}: frame {i} ({image_name(frame, f'{path}: frame {i}')})"
        _check_intrinsics({**data, **frame}, where)
        for key in ("view", "step"):
            if type(frame.get(key, 0)) is not int:
                raise InputError(f"{where}: {key} must be a whole number, not {one_line(repr(frame[key]))}")
        exposure = frame.get("exposure", 0)
        if type(exposure) not in (int, float) or not (0 <= exposure < math.inf):
            raise InputError(
                f"{where}: exposure must be a duration in seconds, not {one_line(repr(exposure))}"
            )
        if not isinstance(frame.get("sha256"), str | None):
            raise InputError(f"{where}: sha256 must be a text")
        pose = matrix_of_numbers(frame.get("transform_matrix"))
        if pose.shape != (4, 4):
            raise InputError(f"{where} needs a 4x4 transform_matrix of numbers (camera to world)")
        rotation = pose[:3, :3]
        if not np.isfinite(pose).all() or np.abs(rotation @ rotation.T - np.eye(3)).max() > 1e-3:
            raise InputError(f"{where}: the transform_matrix is not a rigid motion")
    _check_photographs(data, path)
    return data


def _check_photographs(data: Mapping[str, Any], path: str | Path) -> None:
    """Make sure that the entry `photographs` of a transforms.json, where there is one, can be understood."""
    entry = data.get("photographs", {"floor": None})
    floor = entry.get("floor", "missing") if isinstance(entry, dict) and len(entry) == 1 else "missing"
    if floor is not None and (type(floor) not in (int, float) or not math.isfinite(floor)):
        raise InputError(
            f'{path}: photographs must be {{"floor": height of the floor in metres, or null}}, not'
            f" {one_line(repr(entry))}"
        )


def _check_intrinsics(values: Mapping[str, Any], where: str) -> None:
    if "fl_x" not in values and "camera_angle_x" not in values:
        raise InputError(
            f"{where} has no intrinsics: give fl_x, fl_y, cx, cy in pixels, or camera_angle_x in radians"
        )
    for key in ("fl_x", "fl_y", "cx", "cy", "w", "h", "camera_angle_x"):
        value = values.get(key, 1)
        if type(value) not in (int, float) or not (0 < value < math.inf):
            raise InputError(f"{where}: {key} must be a positive number, not {one_line(repr(value))}")
    if values.get("w", 1) * values.get("h", 1) > MAX_PIXELS:
        raise InputError(f"{where}: {values['w']} x {values['h']} are more than {MAX_PIXELS} pixels (w, h)")


def intrinsic_matrix(values: Mapping[str, Any], width: int, height: int) -> np.ndarray:
    """Intrinsics (3, 3) [px] of a checked entry."""
    focal = values["fl_x"] if "fl_x" in values else 0.5 * width / math.tan(0.5 * values["camera_angle_x"])
    cx, cy = values.get("cx", width / 2), values.get("cy", height / 2)
    return np.array([[focal, 0, cx], [0, values.get("fl_y", focal), cy], [0, 0, 1]], dtype=np.float64)


def read_image_set(path: str | Path, views: Sequence[int] | None = None) -> ImageSet:
    """Read the images that a transforms.json lists, verifying their checksums where it holds them.

    Args:
        path: .../transforms.json.
        views: read the images of these views only; None reads all.

    Raises:
        InputError: missing image, truncated or changed image, image of another size, no intrinsics, empty mask.
    """
    frames = [frame for frame in _all_frames(path) if views is None or frame["view"] in views]
    if not frames:
        raise InputError(f"{path}: no frame belongs to the views {list(views or ())}")
    return _read_frames(frames, path)


def _all_frames(path: str | Path) -> list[dict[str, Any]]:
    """The frames of a transforms.json, each with what the file says of all."""
    data = read_transforms(path)
    return [{**data, "view": i, "step": 0, **frame} for i, frame in enumerate(data["frames"])]


def _read_frames(frames: Sequence[Mapping[str, Any]], path: str | Path) -> ImageSet:
    """Images of one size, of some frames of a list."""
    folder = Path(path).parent
    files = [image_file(folder, frame["file_path"], path) for frame in frames]
    images = _read_all(files, frames, path)
    height, width = images.shape[1:3]
    poses = np.array([frame["transform_matrix"] for frame in frames], dtype=np.float64)
    return ImageSet(
        images=images,
        viewmats=np.linalg.inv(poses @ OPENGL_TO_OPENCV),
        Ks=np.stack([intrinsic_matrix(frame, width, height) for frame in frames]),
        views=np.array([frame["view"] for frame in frames]),
        steps=np.array([frame["step"] for frame in frames]),
    )


def image_file(folder: Path, name: str, listed_in: str | Path) -> Path:
    """The file of an entry. Raises InputError where there is none."""
    for candidate in (folder / name, folder / f"{name}.png"):
        if candidate.is_file():
            return candidate
    raise InputError(
        f"{folder / name} is missing although {listed_in} lists it: remove it from the list, or render it again with"
        f" `snakemake --cores 2 --forcerun render_static render_dynamic`"
    )


def _read_all(files: Sequence[Path], frames: Sequence[Mapping[str, Any]], path: str | Path) -> np.ndarray:
    """Images of one size (K, H, W, 4), on all cores: decoding and checksums run outside Python's lock."""
    with open_image(files[0].read_bytes(), files[0]) as image:
        width, height = image.size
    for frame in frames:
        w, h = frame.get("w", width), frame.get("h", height)
        if (w, h) != (width, height):
            name = frame["file_path"]
            raise InputError(
                f"{path}: w, h of {name} are {w}x{h}, the image is {width}x{height}: correct them"
            )
    # the first is decoded before memory is taken for all
    first = read_rgba(files[0], frames[0].get("sha256"), (width, height))
    images = np.empty((len(files), *first.shape), dtype=np.uint8)
    images[0] = first

    def read(row: int) -> None:
        images[row] = read_rgba(files[row], frames[row].get("sha256"), (width, height))

    with ThreadPoolExecutor() as pool:
        list(pool.map(read, range(1, len(files))))
    return images


def open_image(content: bytes, where: str | Path, sha256: str | None = None) -> Image.Image:
    """An image with its header read, not its pixels: of one of `FORMATS`, not too large, of this checksum if given."""
    if sha256 is not None and hashlib.sha256(content).hexdigest() != sha256:
        raise InputError(
            f"{where} is damaged or was changed: its sha256 differs from the one in transforms.json; make it again"
        )
    with reading(where, "an image"):
        image = Image.open(BytesIO(content), formats=FORMATS)
        if image.width * image.height > MAX_PIXELS:
            raise ValueError(f"{image.width}x{image.height} pixels are more than {MAX_PIXELS}")
        return image


def read_rgba(path: Path, sha256: str | None, size: tuple[int, int] | None) -> np.ndarray:
    """Pixels (H, W, 4), uint8, of a matte, of this checksum and this width and height if they are given.

    Raises:
        InputError: damaged, of another size, without alpha, with 16 bits a channel, or with an empty mask.
    """
    with open_image(path.read_bytes(), path, sha256) as image:
        if size is not None and image.size != size:
            raise InputError("{} is {}x{}, others {}x{}".format(path, *image.size, *size))
        if image.mode in ("I;16", "I"):
            raise InputError(f"{path} has 16 bits a channel: convert it to 8-bit RGBA")
        with reading(path, "an image"):
            image.load()
            has_alpha = "A" in image.mode or "transparency" in image.info
            pixels = np.asarray(image.convert("RGBA"))
    if not has_alpha:
        raise InputError(f"{path} has no alpha channel: the object's mask must be stored as alpha (RGBA)")
    if not (pixels[..., 3] > 127).any():
        raise InputError(f"{path}: the mask (alpha) is empty, nothing is in the picture: remove this frame")
    return pixels


def load_views(transforms: str | Path, views: Sequence[int] | None = None) -> tuple[torch.Tensor, Cameras]:
    """Straight-alpha RGBA images (V, H, W, 4) in [0, 1] and their cameras, of an image set at one time."""
    images = read_image_set(transforms, views)
    pixels = torch.from_numpy(images.images).float() / 255
    return pixels, _cameras(images, np.arange(len(pixels)))


def load_videos(
    transforms: str | Path, views: Sequence[int], dt: float | None = None, sub_frames: int = SUB_FRAMES
) -> tuple[Observation, ...]:
    """The videos of some views, with their pixels as they are stored: 1 GB for 400 frames of 800 x 800.

    Views that share steps, size and exposure are one observation; so all views of a scene that was rendered are. Frames
    whose exposure began before step 0 are left out, as nothing is simulated there.

    Args:
        transforms: .../transforms.json. A frame's ``exposure`` [s] has its middle at the frame's step.
        views: numbers of the views.
        dt: duration of a step [s], which turns exposures into steps; None: as if all were instants.
        sub_frames: most renders that are averaged to a frame, see `exposed_steps`.

    Raises:
        InputError: see `read_image_set` and `Observation`; a view that was not filmed, or only before step 0.
    """
    found = []
    for (_, _, exposure), frames in _shots(transforms, views, dt, sub_frames).items():
        images = _read_frames(frames, transforms)
        order = list(dict.fromkeys(frame["view"] for frame in frames))
        steps, index, columns = images.video(order)
        pixels, cameras = torch.from_numpy(images.images[index]), _cameras(images, columns)
        offsets, shares = exposure
        found.append(Observation(steps, pixels, cameras, offsets, shares if len(offsets) > 1 else None))
    return tuple(found)


def filmed_steps(
    transforms: str | Path, views: Sequence[int], dt: float | None = None, sub_frames: int = SUB_FRAMES
) -> tuple[int, ...]:
    """Steps whose states a comparison with `load_videos` of the same arguments needs, ascending, without its images."""
    shots = _shots(transforms, views, dt, sub_frames)
    return tuple(sorted({
        step + offset for steps, _, (offsets, _) in shots for step in steps for offset in (*offsets, 0)
    }))  # fmt: skip


def _shots(
    transforms: str | Path, views: Sequence[int], dt: float | None, sub_frames: int
) -> dict[tuple, list[dict[str, Any]]]:
    """Frames of each observation, view by view, under (steps, size, (offsets, shares) of the exposure).

    A view whose camera or exposure changes along the video is one of several observations.
    """
    frames = _all_frames(transforms)
    filmed = sorted({frame["view"] for frame in frames})
    if missing := [view for view in views if view not in filmed]:
        raise InputError(
            f"{transforms}: view {missing[0]} is not among the filmed views {filmed}: film more"
            " (dataset.dynamic.views), or let the method use fewer (methods.<name>.material.views, identify.views)"
        )
    shots: dict[tuple, list[dict[str, Any]]] = {}
    for view in dict.fromkeys(views):
        columns: dict[tuple, list[dict[str, Any]]] = {}
        for frame in sorted((f for f in frames if f["view"] == view), key=lambda f: f["step"]):
            exposure = exposed_steps(frame.get("exposure", 0) / dt if dt else 0.0, sub_frames)
            if frame["step"] + exposure[0][0] >= 0:
                columns.setdefault((exposure, _camera_key(frame)), []).append(frame)
        if not columns:
            raise InputError(
                f"{transforms}: every exposure of view {view} begins before step 0, which is the start: check the steps"
            )
        for (exposure, _), column in columns.items():
            steps = tuple(frame["step"] for frame in column)
            shots.setdefault((steps, (column[0].get("w"), column[0].get("h")), exposure), []).extend(column)
    return shots


def _camera_key(frame: Mapping[str, Any]) -> tuple:
    """What tells cameras apart; poses that agree to a micrometre are one."""
    intrinsics = (frame.get(key) for key in ("w", "h", "fl_x", "fl_y", "cx", "cy", "camera_angle_x"))
    pose = np.asarray(frame["transform_matrix"], dtype=np.float64)
    return (*intrinsics, *(pose.round(6) + 0.0).ravel().tolist())


def load_observation(transforms: str | Path, views: Sequence[int]) -> Observation:
    """The video of views that were filmed at the same steps by cameras of one size that stand still, without blur.

    Raises:
        InputError: see `load_videos`; views that differ in these.
    """
    found = load_videos(transforms, views)
    if len(found) > 1:
        raise InputError(
            f"{transforms}: views {list(views)} were not filmed at the same steps by cameras of one size that stand"
            " still: choose one of them"
        )
    return found[0]


def _cameras(images: ImageSet, index: np.ndarray) -> Cameras:
    return Cameras(
        torch.from_numpy(images.viewmats[index]).float(),
        torch.from_numpy(images.Ks[index]).float(),
        images.width,
        images.height,
    )
