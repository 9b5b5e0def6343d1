"""A scene's dataset as two files that travel: its images, without loss, and the ground truth that is compared.

Images: a ZIP archive with a folder a set: transforms.json and lossless WebP images, hidden colours included. Unpacking
copies them; the sha256 of each file is in transforms.json.

Ground truth: HDF5 with positions as multiples of 2^-14 m (61 um: at most 31 um off along an axis, 1e-9 m^2 in the mean
square), elastic deformation gradients as multiples of 2^-16, everything else exactly. All tracers stay; of the
particles a random part does, with volumes and masses scaled up to the same total. Velocities are left out.

The same data give the same bytes.
"""

from __future__ import annotations

import hashlib
import json
import os
import re
import zipfile
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from neuma_lib.errors import InputError
from neuma_lib.io.files import atomic, existing, one_line, parse_json, reading, write_json, zip_member
from neuma_lib.io.hdf5 import read_arrays, write_arrays
from neuma_lib.io.images import checked_transforms, open_image, read_image_set, read_transforms

FORMAT = "NeuMA ground truth 2"
"""Kind and version of a packed ground truth, an attribute of the file."""
TRUTH = ("frames", "time", "vol0", "mass", "x", "F", "tracers", "tracers_again")
"""Quantities that a packed ground truth has."""
STEPS = {"x": 2.0**-14, "tracers": 2.0**-14, "tracers_again": 2.0**-14, "F": 2.0**-16}
"""What a quantity is rounded to multiples of [m; F: 1]; others are kept exactly."""
WEBP = {"lossless": True, "exact": True, "quality": 75, "method": 4}
"""Exact keeps the colours of transparent pixels; more effort saves 1.5 % in three times the time."""
MAX_TRANSFORMS = 2**24
"""Largest transforms.json that is unpacked [bytes]: 20,000 frames. Deflate could hide a gigabyte in a megabyte."""
IMAGE_NAME = re.compile(r"[\w-][\w.-]{0,99}\.webp", re.ASCII)
"""Names that an unpacked image may have: no folder, no hidden file, nothing but an image."""
REMEDY = "put the packed file there, or set dataset.packed: null"

Progress = Callable[[int, int], object]
"""Is called with the number of images that are done, and of all."""


def pack_images(
    path: str | Path, sets: Mapping[str, str | Path], progress: Progress = lambda done, total: None
) -> None:
    """Pack image sets into one file.

    Args:
        path: of the file.
        sets: name of a set -> its transforms.json, for example of "static" and "dynamic".

    Raises:
        InputError: as `neuma_lib.io.images.read_image_set`; or two images of a set have the same name.
    """
    found = {name: (read_transforms(file), read_image_set(file).images) for name, file in sets.items()}
    total, done = sum(len(images) for _, images in found.values()), 0
    with atomic(path) as partial, zipfile.ZipFile(partial, "w") as archive:
        for name, (transforms, images) in found.items():
            frames = [
                {**frame, "file_path": f"{Path(frame['file_path']).stem}.webp"}
                for frame in transforms["frames"]
            ]
            _check_names(frames, sets[name])
            for frame, image in zip(frames, images, strict=True):
                content = BytesIO()
                Image.fromarray(image).save(content, "WEBP", **WEBP)
                frame["sha256"] = hashlib.sha256(content.getvalue()).hexdigest()
                # ZipInfo: without the time of day
                archive.writestr(zipfile.ZipInfo(f"{name}/{frame['file_path']}"), content.getvalue())
                progress(done := done + 1, total)
            text = json.dumps({**transforms, "frames": frames}, allow_nan=False)
            archive.writestr(zipfile.ZipInfo(f"{name}/transforms.json"), text, zipfile.ZIP_DEFLATED, 9)


def unpack_images(
    path: str | Path,
    name: str,
    target: str | Path,
    steps: Sequence[int] | None = None,
    progress: Progress = lambda done, total: None,
) -> None:
    """Write a packed set: a transforms.json, and its images beside it.

    Args:
        path: of the packed file.
        name: of the set.
        target: the transforms.json.
        steps: simulation steps that the set must have, in ascending order; None: any.

    Raises:
        InputError: the file is missing, damaged, foreign or of other steps; or another image has the name of one.
    """
    kind, target = "a packed dataset", Path(target)
    with existing(path, REMEDY).open("rb") as file:
        with reading(path, kind):
            archive = zipfile.ZipFile(file)
            transforms = _packed_set(archive, name, path)
        frames = transforms["frames"]
        if steps is not None:
            _check_steps(path, sorted({frame.get("step", 0) for frame in frames}), steps)
        target.unlink(missing_ok=True)  # a folder without transforms.json is an unfinished one
        for done, frame in enumerate(frames, 1):
            member, image = f"{name}/{frame['file_path']}", target.parent / frame["file_path"]
            with reading(path, kind):
                info = archive.getinfo(member)
                content = zip_member(archive, info, info.compress_size)  # an image is stored
            open_image(content, f"{path}: {member}", frame["sha256"]).close()
            if not os.path.lexists(image):
                with atomic(image) as partial:
                    partial.write_bytes(content)
            elif not image.is_file() or image.read_bytes() != content:
                raise InputError(
                    f"{image} is there already, with other content than in {path}: remove its folder"
                )
            progress(done, len(frames))
        write_json(target, transforms)


def _packed_set(archive: zipfile.ZipFile, name: str, path: str | Path) -> dict[str, Any]:
    """The transforms.json of a set, whose images are all in the archive under names that are safe to write."""
    if sum(info.compress_size for info in archive.infolist()) > Path(path).stat().st_size:
        raise ValueError("its members overlap or are cut off")
    info = archive.getinfo(f"{name}/transforms.json")
    where = f"{path}: {info.filename}"
    transforms = checked_transforms(parse_json(zip_member(archive, info, MAX_TRANSFORMS), where), where)
    _check_names(transforms["frames"], where)
    for frame in transforms["frames"]:
        if not frame.get("sha256") or f"{name}/{frame['file_path']}" not in archive.NameToInfo:
            raise ValueError(f"it lacks the image {name}/{frame['file_path']}, or its sha256")
    return transforms


def _check_names(frames: Sequence[Mapping[str, Any]], where: str | Path) -> None:
    for name, count in Counter(frame["file_path"] for frame in frames).items():
        if count > 1 or not IMAGE_NAME.fullmatch(name):
            raise InputError(f"{where}: {name} is listed twice or no plain image name: rename the image")


def pack_truth(
    path: str | Path, particles_file: str | Path, *, particles: int, deformations: int, seed: int
) -> None:
    """Pack the particles.h5 of a scene: at most ``particles`` of them, chosen by ``seed``, F of ``deformations``."""
    arrays, attributes = read_arrays(particles_file, required=TRUTH, only=TRUTH)
    count = arrays["x"].shape[1]
    drawn = np.random.default_rng(seed).permutation(count)
    chosen = np.sort(drawn[:particles])  # neighbours in the file move alike, which compresses
    for name in ("vol0", "mass"):
        arrays[name] = (count / len(chosen) * arrays[name][chosen].astype(np.float64)).astype(np.float32)
    arrays["x"], arrays["F"] = arrays["x"][:, chosen], arrays["F"][:, np.sort(drawn[:deformations])]
    arrays |= {name: _encoded(arrays[name], step) for name, step in STEPS.items()}
    packed = {"particles": len(chosen), "of": count, "rounded_to": STEPS}
    attributes = {"format": FORMAT, **attributes, "packed": packed}
    write_arrays(path, {name: arrays[name] for name in TRUTH}, attributes, compress=True)


def unpack_truth(
    path: str | Path, particles_file: str | Path, steps: Sequence[int] | None = None, dt: float | None = None
) -> None:
    """Write a packed ground truth as particles.h5.

    Args:
        path, particles_file: of the packed file, and of the one to write.
        steps, dt: simulation steps of its frames, and time step [s], that it must have.

    Raises:
        InputError: the file is missing, damaged, foreign, of another version or of other steps.
    """
    arrays, attributes = read_arrays(existing(path, REMEDY), required=TRUTH, only=TRUTH)
    if (found := attributes.pop("format", None)) != FORMAT:
        raise InputError(f"{path} holds {one_line(found)}, not {FORMAT}: give the other file, or pack again")
    if steps is not None:
        _check_steps(path, arrays["frames"].tolist(), steps)
    if dt is not None and attributes.get("dt") != dt:
        raise InputError(
            f"{path} was simulated with dt = {attributes.get('dt')} s, the scene has {dt} s: use the settings that it"
            " was made with, or pack the scene again"
        )
    for name, step in STEPS.items():
        if arrays[name].dtype != np.uint32 or arrays[name].ndim < 3:
            raise InputError(f"{path}: {name} is not packed as {FORMAT} says: pack the scene again")
        arrays[name] = _decoded(arrays[name], step)
    write_arrays(particles_file, {name: arrays[name] for name in TRUTH}, attributes)


def _encoded(array: np.ndarray, step: float) -> np.ndarray:
    """Whole multiples of ``step`` as what a particle's change in time differs by from its neighbour's (T, N, ...)."""
    whole = np.rint(array / step).astype(np.int32)
    for axis in (0, 1):
        whole = np.diff(whole, axis=axis, prepend=np.int32(0))
    return ((whole << 1) ^ (whole >> 31)).astype(np.uint32)  # small numbers of both signs become small


def _decoded(code: np.ndarray, step: float) -> np.ndarray:
    """The array that `_encoded` was given, up to half a step."""
    whole = (code >> 1).astype(np.int32) ^ -(code & 1).astype(np.int32)
    for axis in (1, 0):
        whole = np.cumsum(whole, axis=axis, dtype=np.int32)
    return (whole * step).astype(np.float32)


def _check_steps(path: str | Path, found: Sequence[int], wanted: Sequence[int]) -> None:
    if list(found) != list(wanted):
        raise InputError(
            f"{path} has {len(found)} frames at steps {_brief(found)}, the settings ask for {len(wanted)} at"
            f" {_brief(wanted)}: use the settings that it was made with (dataset.steps, dataset.stride, dataset.frames)"
        )


def _brief(steps: Sequence[int]) -> str:
    return ", ".join(map(str, steps)) if len(steps) < 5 else f"{steps[0]}, {steps[1]}, ..., {steps[-1]}"
