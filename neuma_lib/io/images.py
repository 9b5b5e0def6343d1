"""Calibrated images: transforms.json and the images that it lists."""

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
from scipy import ndimage

from neuma_lib.errors import InputError
from neuma_lib.io.datasets.released import check_pose, image_name, matrix_of_numbers, released_frames
from neuma_lib.io.files import one_line, read_json, read_regular, reading, sha256_file, write_json
from neuma_lib.splatting.cameras import Cameras
from neuma_lib.splatting.observation import Observation, exposed_steps


@dataclass(frozen=True)
class ImageSet:
    """Calibrated images, in the order of transforms.json.

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


FORMATS = ("PNG", "JPEG", "WEBP")
"""Supported image formats, by Pillow's names. Decoders of other formats are less well tested."""
MAX_PIXELS = 2**26
"""Maximum size of an image: 8192 x 8192 pixels, 256 MiB of RGBA."""
MAX_INTRINSIC = 1e7
"""Limit of focal lengths, principal points and image sizes [px]."""
MIN_FOCAL = 0.5
"""Focal length that every lens exceeds [px]."""
EXPOSURE_SAMPLES = 5
"""Default maximum number of renders that are averaged to a frame."""
OPENGL_TO_OPENCV = np.diag([1.0, -1.0, -1.0, 1.0])


def write_transforms(
    path: str | Path, intrinsics: Mapping[str, float], frames: Sequence[Mapping[str, Any]], **extra: Any
) -> None:
    """Write transforms.json for existing images, with the sha256 of each.

    Args:
        path: .../transforms.json.
        intrinsics: fl_x, fl_y, cx, cy [px], w, h.
        frames: dicts with ``file_path`` relative to the folder, ``transform_matrix`` (camera to world, OpenGL
            axes, 4 x 4) and optional entries (``view``, ``step``, ``time``).
        extra: further top-level entries.
    """
    folder = Path(path).parent
    entries = [{**frame, "sha256": sha256_file(folder / frame["file_path"])} for frame in frames]
    write_json(path, {**intrinsics, **extra, "frames": entries})


def list_images(
    source: str | Path, path: str | Path, scale: float = 1.0, offset: Sequence[float] | None = None
) -> ImageSet:
    """Write a transforms.json that refers to the images of another list, and return these images.

    Args:
        source: a transforms.json, or a list in the layout of the authors' release.
        path: the new transforms.json.
        scale, offset: see `transform_world`; None: no offset.

    Raises:
        InputError: see `read_image_set`.
    """
    images = read_image_set(source)
    data = read_transforms(source)
    files = [image_file(Path(source).parent, frame["file_path"], source) for frame in data["frames"]]
    Path(path).parent.mkdir(parents=True, exist_ok=True)
    names = [relative_to(path, file) for file in files]
    frames = [{**f, "file_path": name} for f, name in zip(data.pop("frames"), names, strict=True)]
    world = transform_world(frames, scale, (0.0, 0.0, 0.0) if offset is None else offset)
    write_transforms(path, data, frames, **world)
    return read_image_set(path) if world else images


def relative_to(path: str | Path, file: Path) -> str:
    """Path of a file relative to the folder of the list ``path``."""
    return os.path.relpath(file.resolve(), Path(path).parent.resolve())


def transform_world(
    frames: Sequence[dict[str, Any]], scale: float, offset: Sequence[float]
) -> dict[str, Any]:
    """Transform camera positions x to ``scale x + offset`` [m], in place.

    Returns:
        Entry ``world`` of transforms.json, with ``scale`` and ``offset``; empty for the identity.
    """
    if scale == 1.0 and not any(offset):
        return {}
    for frame in frames:
        pose = np.array(frame["transform_matrix"], dtype=np.float64)
        pose[:3, 3] = scale * pose[:3, 3] + offset
        frame["transform_matrix"] = pose.tolist()
    return {"world": {"scale": scale, "offset": [float(x) for x in offset]}}


def read_transforms(path: str | Path) -> dict[str, Any]:
    """Read and check transforms.json: a file, a pose and intrinsics (its own or common ones) for every frame.

    A list in the layout of the authors' release is converted (`neuma_lib.io.datasets.released`).

    Raises:
        InputError: a missing or wrong entry; names the file, the frame and the entry.
    """
    return checked_transforms(read_json(path), path)


def checked_transforms(data: Any, path: str | Path) -> dict[str, Any]:
    """The content of a transforms.json, checked (see `read_transforms`); ``path`` is for messages."""
    if isinstance(data, list):
        data = {"frames": released_frames(data, path)}
    frames = data.get("frames") if isinstance(data, dict) else None
    if not isinstance(frames, list) or not frames:
        raise InputError(f"{path}: frames", "the list is missing or empty")
    names: set[str] = set()
    for i, frame in enumerate(frames):
        where = f"{path}: frame {i} ({image_name(frame, f'{path}: frame {i}')})"
        _check_intrinsics({**data, **frame}, where)
        for key in ("view", "step"):
            if type(frame.get(key, 0)) is not int:
                raise InputError(f"{where}: {key}", f"must be an integer, not {one_line(repr(frame[key]))}")
        exposure = frame.get("exposure", 0)
        if type(exposure) not in (int, float) or not (0 <= exposure < math.inf):
            problem = f"must be a duration in seconds, not {one_line(repr(exposure))}"
            raise InputError(f"{where}: exposure", problem)
        if not isinstance(frame.get("sha256"), str | None):
            raise InputError(f"{where}: sha256", "must be a text")
        pose = matrix_of_numbers(frame.get("transform_matrix"))
        if pose.shape != (4, 4):
            raise InputError(f"{where}: transform_matrix", "must be a 4x4 matrix (camera to world)")
        check_pose(pose, f"{where}: transform_matrix")
        if (file := os.path.normpath(frame["file_path"])) in names:
            raise InputError(f"{where}: file_path", "occurs in an earlier frame", "Remove one of them")
        names.add(file)
    _check_photographs(data, path)
    return data


def _check_photographs(data: Mapping[str, Any], path: str | Path) -> None:
    """Check the optional entry `photographs` of a transforms.json."""
    entry = data.get("photographs", {"floor": None})
    floor = entry.get("floor", "missing") if isinstance(entry, dict) and len(entry) == 1 else "missing"
    if floor is not None and (type(floor) not in (int, float) or not math.isfinite(floor)):
        expected = '{"floor": height of the floor in metres, or null}'
        raise InputError(f"{path}: photographs", f"must be {expected}, not {one_line(repr(entry))}")


def _check_intrinsics(values: Mapping[str, Any], where: str) -> None:
    if "fl_x" not in values and "camera_angle_x" not in values:
        remedy = "Add fl_x, fl_y, cx, cy in pixels, or camera_angle_x in radians"
        raise InputError(where, "has no intrinsics", remedy)
    for key in ("fl_x", "fl_y", "cx", "cy", "w", "h", "camera_angle_x"):
        value = values.get(key, 1)
        least = MIN_FOCAL if key in ("fl_x", "fl_y") else 0
        limit = math.pi if key == "camera_angle_x" else MAX_INTRINSIC
        if type(value) not in (int, float) or not (least < value < limit):
            problem = f"must be a number above {least:g} and below {limit:g}, not {one_line(repr(value))}"
            raise InputError(f"{where}: {key}", problem)
    if values.get("w", 1) * values.get("h", 1) > MAX_PIXELS:
        problem = f"{values['w']} x {values['h']} pixels exceed the maximum of {MAX_PIXELS}"
        raise InputError(f"{where}: w, h", problem)


def intrinsic_matrix(values: Mapping[str, Any], width: int, height: int) -> np.ndarray:
    """Intrinsics (3, 3) [px] of a checked entry."""
    focal = values["fl_x"] if "fl_x" in values else 0.5 * width / math.tan(0.5 * values["camera_angle_x"])
    cx, cy = values.get("cx", width / 2), values.get("cy", height / 2)
    return np.array([[focal, 0, cx], [0, values.get("fl_y", focal), cy], [0, 0, 1]], dtype=np.float64)


def read_image_set(path: str | Path, views: Sequence[int] | None = None) -> ImageSet:
    """Read the images of a transforms.json and verify the checksums in it.

    Args:
        path: .../transforms.json.
        views: views to read; None reads all.

    Raises:
        InputError: missing, truncated or changed image, image of another size, no intrinsics, empty mask.
    """
    frames = [frame for frame in _all_frames(path) if views is None or frame["view"] in views]
    if not frames:
        raise InputError(path, f"no frame belongs to the views {list(views or ())}")
    return _read_frames(frames, path)


def read_labels(path: str | Path) -> np.ndarray:
    """Numbers of the bodies in the pixels of all images of a transforms.json, 0 for none, shape (K, H, W).

    Raises:
        InputError: a frame has no label_path, or its image is missing or has another size than the first.
    """
    return _labels(_all_frames(path), path)


def _labels(frames: Sequence[Mapping[str, Any]], path: str | Path) -> np.ndarray:
    labels, folder = [], Path(path).parent
    for k, frame in enumerate(frames):
        if not isinstance(frame.get("label_path"), str):
            problem = "has no label_path"
            raise InputError(f"{path}: frame {k}", problem, "Give an image of the bodies' numbers")
        file = image_file(folder, frame["label_path"], path)
        with open_image(read_regular(file), file) as image:
            labels.append(np.array(image.convert("L")))
        if labels[-1].shape != labels[0].shape:
            raise InputError(file, f"has shape {labels[-1].shape}, but the first has {labels[0].shape}")
    return np.stack(labels)


def list_body(source: str | Path, path: str | Path, body: int) -> tuple[int, int]:
    """Write a transforms.json with images in which only one of several bodies is visible.

    Images have an empty mask where their label is another one. A pixel without a label that is covered by less than
    half belongs to the body of the nearest label, since contours at half coverage would otherwise lie about a fifth of
    a pixel too far inside. The entry ``body`` is the number of the body in the labels, which remain those of all bodies
    (`read_hidden`). Images without the body are not listed.

    Args:
        source: a transforms.json with labels (`read_labels`).
        path: the new transforms.json, next to which the images are written.
        body: number of the body in the labels.

    Returns:
        numbers of listed images, and of all.

    Raises:
        InputError: see `read_image_set` and `read_labels`, or no image shows the body.
    """
    data, labels, images = read_transforms(source), read_labels(source), read_image_set(source).images
    Path(path).parent.mkdir(parents=True, exist_ok=True)
    frames = []
    for frame, pixels, label in zip(data.pop("frames"), images, labels, strict=True):
        nearest = np.asarray(
            ndimage.distance_transform_edt(label == 0, return_distances=False, return_indices=True)
        )
        edge = (label == 0) & (pixels[..., 3] <= 127)
        alpha = np.where(np.where(edge, label[tuple(nearest)], label) == body, pixels[..., 3], 0)
        if not (alpha > 127).any():
            continue
        name = f"{Path(frame['file_path']).stem}.png"
        Image.fromarray(np.dstack([pixels[..., :3], alpha]).astype(np.uint8)).save(Path(path).parent / name)
        label_file = image_file(Path(source).parent, frame["label_path"], source)
        frames.append({**frame, "file_path": name, "label_path": relative_to(path, label_file)})
    if not frames:
        raise InputError(source, f"no image shows body {body}", "Check the labels of the images")
    write_transforms(path, data, frames, body=body)
    return len(frames), len(labels)


def read_hidden(path: str | Path) -> np.ndarray | None:
    """Pixels of all images of a list of `list_body` in which another body is visible, shape (K, H, W).

    None for the images of a body without others.
    """
    return _hidden(_all_frames(path), path)


def _hidden(frames: Sequence[Mapping[str, Any]], path: str | Path) -> np.ndarray | None:
    if "body" not in frames[0]:
        return None
    labels = _labels(frames, path)
    return (labels != 0) & (labels != frames[0]["body"])


def _all_frames(path: str | Path) -> list[dict[str, Any]]:
    """The frames of a transforms.json, each with the entries common to all."""
    data = read_transforms(path)
    return [{**data, "view": i, "step": 0, **frame} for i, frame in enumerate(data["frames"])]


def _read_frames(frames: Sequence[Mapping[str, Any]], path: str | Path) -> ImageSet:
    """Images of some frames of a list, which have one size."""
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
    """The file of an entry. Raises InputError if it does not exist."""
    for candidate in (folder / name, folder / f"{name}.png"):
        if candidate.is_file():
            return candidate
    raise InputError(
        folder / name,
        f"does not exist but is listed in {listed_in}",
        "Remove it from the list, or render it with `snakemake --cores 2 --forcerun render_static render_dynamic`",
    )


def _read_all(files: Sequence[Path], frames: Sequence[Mapping[str, Any]], path: str | Path) -> np.ndarray:
    """Images of one size (K, H, W, 4), on all cores: decoding and checksums release Python's global lock."""
    with open_image(read_regular(files[0]), files[0]) as image:
        width, height = image.size
    for frame in frames:
        w, h = frame.get("w", width), frame.get("h", height)
        if (w, h) != (width, height):
            name = frame["file_path"]
            raise InputError(f"{path}: w, h of {name}", f"are {w}x{h}, but the image is {width}x{height}")
    # the first image is decoded before memory is allocated for all
    first = read_rgba(files[0], frames[0].get("sha256"), (width, height))
    images = np.empty((len(files), *first.shape), dtype=np.uint8)
    images[0] = first

    def read(row: int) -> None:
        images[row] = read_rgba(files[row], frames[row].get("sha256"), (width, height))

    with ThreadPoolExecutor() as pool:
        list(pool.map(read, range(1, len(files))))
    return images


def open_image(
    content: bytes, where: str | Path, sha256: str | None = None, formats: Sequence[str] = FORMATS
) -> Image.Image:
    """An image of which only the header is read. Checks the format, the size, and the checksum if given."""
    if sha256 is not None and hashlib.sha256(content).hexdigest() != sha256:
        problem = "is damaged or was changed: its sha256 differs from the one in transforms.json"
        raise InputError(where, problem, "Regenerate it")
    with reading(where, "an image"):
        image = Image.open(BytesIO(content), formats=formats)
        if image.width * image.height > MAX_PIXELS:
            raise ValueError(f"{image.width}x{image.height} pixels exceed the maximum of {MAX_PIXELS}")
    if image.mode.startswith(("I", "F")):
        raise InputError(where, "has 16 bits per channel or more", "Convert it to 8 bits per channel")
    if image.format != "MPO" and getattr(image, "is_animated", False):  # MPO: a photograph with its preview
        raise InputError(where, "is an animation", "Save one of its pictures")
    return image


def read_rgba(path: Path, sha256: str | None, size: tuple[int, int] | None) -> np.ndarray:
    """Pixels (H, W, 4), uint8, of a matte, with checksum and (width, height) verified if given.

    Raises:
        InputError: damaged, of another size, without alpha, with 16 bits per channel, or with an empty mask.
    """
    with open_image(read_regular(path), path, sha256) as image:
        if size is not None and image.size != size:
            raise InputError(path, "is {}x{}, but expected {}x{}".format(*image.size, *size))
        with reading(path, "an image"):
            image.load()
            has_alpha = "A" in image.mode or "transparency" in image.info
            pixels = np.asarray(image.convert("RGBA"))
    if not has_alpha:
        raise InputError(path, "has no alpha channel", "Store the mask of the object as alpha (RGBA)")
    if not (pixels[..., 3] > 127).any():
        raise InputError(path, "the mask (alpha) is empty", "Remove this frame")
    return pixels


def load_views(transforms: str | Path, views: Sequence[int] | None = None) -> tuple[torch.Tensor, Cameras]:
    """Straight-alpha RGBA images (V, H, W, 4) in [0, 1] of a static image set, and their cameras."""
    images = read_image_set(transforms, views)
    pixels = torch.from_numpy(images.images).float() / 255
    return pixels, _cameras(images, np.arange(len(pixels)))


def load_videos(
    transforms: str | Path,
    views: Sequence[int],
    dt: float | None = None,
    exposure_samples: int = EXPOSURE_SAMPLES,
) -> tuple[Observation, ...]:
    """The videos of some views, as uint8: 1 GB for 400 frames of 800 x 800 pixels.

    Views with the same steps, size and exposure form one observation, as all views of a rendered scene do. Frames whose
    exposure begins before step 0, the start of the simulation, are skipped.

    Args:
        transforms: .../transforms.json. The ``exposure`` [s] of a frame is centred at its step.
        views: numbers of the views.
        dt: duration of a step [s], which converts exposures to steps; None: instantaneous exposures.
        exposure_samples: maximum number of renders that are averaged to a frame, see `exposed_steps`.

    Raises:
        InputError: see `read_image_set` and `Observation`; a view that was not filmed, or only before step 0.
    """
    observations = []
    for (steps, _, exposure), frames in _shots(transforms, views, dt, exposure_samples).items():
        images = _read_frames(frames, transforms)
        index = np.arange(len(frames)).reshape(-1, len(steps)).T  # (T, V)
        pixels, cameras = torch.from_numpy(images.images[index]), _cameras(images, index[0])
        offsets, shares = exposure
        shares = shares if len(offsets) > 1 else None
        hidden = _hidden(frames, transforms)
        hidden = None if hidden is None else torch.from_numpy(hidden[index])
        observations.append(Observation(steps, pixels, cameras, offsets, shares, hidden))
    return tuple(observations)


def filmed_steps(
    transforms: str | Path,
    views: Sequence[int],
    dt: float | None = None,
    exposure_samples: int = EXPOSURE_SAMPLES,
) -> tuple[int, ...]:
    """Steps needed to compare with `load_videos` of the same arguments, ascending. Reads no images."""
    shots = _shots(transforms, views, dt, exposure_samples)
    return tuple(sorted({
        step + offset for steps, _, (offsets, _) in shots for step in steps for offset in (*offsets, 0)
    }))  # fmt: skip


def _shots(
    transforms: str | Path, views: Sequence[int], dt: float | None, exposure_samples: int
) -> dict[tuple, list[dict[str, Any]]]:
    """(steps, size, (offsets, shares) of the exposure) of each observation -> its frames, view by view.

    A view whose camera or exposure changes during the video belongs to several observations.
    """
    frames = _all_frames(transforms)
    filmed = sorted({frame["view"] for frame in frames})
    if missing := [view for view in views if view not in filmed]:
        raise InputError(
            f"{transforms}: view {missing[0]}",
            f"is not one of the filmed views {filmed}",
            "Film more views (dataset.dynamic.views), or use fewer (training.views, identify.views)",
        )
    shots: dict[tuple, list[dict[str, Any]]] = {}
    for view in dict.fromkeys(views):
        columns: dict[tuple, list[dict[str, Any]]] = {}
        for frame in sorted((f for f in frames if f["view"] == view), key=lambda f: f["step"]):
            exposure = exposed_steps(frame.get("exposure", 0) / dt if dt else 0.0, exposure_samples)
            if frame["step"] + exposure[0][0] >= 0:
                columns.setdefault((exposure, _camera_key(frame)), []).append(frame)
        if not columns:
            problem = "every exposure begins before step 0, the start of the simulation"
            raise InputError(f"{transforms}: view {view}", problem, "Correct the steps")
        for (exposure, _), column in columns.items():
            steps = tuple(frame["step"] for frame in column)
            shots.setdefault((steps, (column[0].get("w"), column[0].get("h")), exposure), []).extend(column)
    return shots


def _camera_key(frame: Mapping[str, Any]) -> tuple:
    """Key that identifies a camera; poses are compared to 1e-6."""
    intrinsics = (frame.get(key) for key in ("w", "h", "fl_x", "fl_y", "cx", "cy", "camera_angle_x"))
    pose = np.asarray(frame["transform_matrix"], dtype=np.float64)
    return (*intrinsics, *(pose.round(6) + 0.0).ravel().tolist())


def load_observation(transforms: str | Path, views: Sequence[int]) -> Observation:
    """The video of views with the same steps, taken by static cameras of one image size, without motion blur.

    Raises:
        InputError: see `load_videos`; views that differ in steps or size, or whose camera moves.
    """
    observations = load_videos(transforms, views)
    if len(observations) > 1:
        problem = f"views {list(views)} differ in steps or image size, or a camera moves"
        raise InputError(transforms, problem, "Choose one view")
    return observations[0]


def _cameras(images: ImageSet, index: np.ndarray) -> Cameras:
    return Cameras(
        torch.from_numpy(images.viewmats[index]).float(),
        torch.from_numpy(images.Ks[index]).float(),
        images.width,
        images.height,
    )
