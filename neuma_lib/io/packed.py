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
import re
import zipfile
import zlib
from collections.abc import Callable, Mapping, Sequence
from io import BytesIO
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from PIL import Image

from neuma_lib.errors import InputError
from neuma_lib.io.files import atomic, one_line, parse_json, write_json
from neuma_lib.io.hdf5 import read_arrays, write_arrays
from neuma_lib.io.images import checked_transforms, open_image, read_image_set, read_transforms

FORMAT = "NeuMA ground truth 2"
"""Kind and version of a packed ground truth, an attribute of the file."""
VERSION = ("v110", "v110")
"""Of HDF5, 1.10 of 2016."""
STEPS = {"x": 2.0**-14, "tracers": 2.0**-14, "tracers_again": 2.0**-14, "F": 2.0**-16}
"""What a quantity is rounded to multiples of [m; F: 1]; others are kept exactly."""
WEBP = {"lossless": True, "exact": True, "quality": 75, "method": 4}
"""Exact keeps the colours of transparent pixels; more effort saves 1.5 % in three times the time."""
MAX_TRANSFORMS = 2**24
"""Largest transforms.json that is unpacked [bytes]: 20,000 frames. Deflate could hide a gigabyte in a megabyte."""
IMAGE_NAME = re.compile(r"[\w-][\w.-]{0,99}\.webp", re.ASCII)
"""Names that an unpacked image may have: no folder, no hidden file, nothing but an image."""

Progress = Callable[[int, int], None]


# ----------------------------------------------------------------------------------------------------- images


def pack_images(path: str | Path, sets: Mapping[str, str | Path], progress: Progress | None = None) -> None:
    """Pack image sets into one file.

    Args:
        path: of the file.
        sets: name of a set -> its transforms.json, for example of "static" and "dynamic".
        progress: called with the number of packed images and of all.

    Raises:
        InputError: as `neuma_lib.io.images.read_image_set`; or two images of a set have the same name.
    """
    found = {name: (read_transforms(file), read_image_set(file).images) for name, file in sets.items()}
    total, done = sum(len(images) for _, images in found.values()), 0
    with atomic(path) as partial, zipfile.ZipFile(partial, "w") as archive:
        for name, (transforms, images) in found.items():
            frames = []
            for frame, image in zip(transforms["frames"], images, strict=True):
                member = f"{Path(frame['file_path']).stem}.webp"
                if not IMAGE_NAME.fullmatch(member) or member in (f["file_path"] for f in frames):
                    raise InputError(
                        f"{sets[name]}: {member} is listed twice or no plain name: rename the image"
                    )
                content = BytesIO()
                Image.fromarray(image).save(content, "WEBP", **WEBP)
                archive.writestr(zipfile.ZipInfo(f"{name}/{member}"), content.getvalue())
                digest = hashlib.sha256(content.getvalue()).hexdigest()
                frames.append({**frame, "file_path": member, "sha256": digest})
                done += 1
                if progress is not None:
                    progress(done, total)
            text = json.dumps({**transforms, "frames": frames}, allow_nan=False)
            # ZipInfo: without the time of day
            member = zipfile.ZipInfo(f"{name}/transforms.json")
            archive.writestr(member, text, zipfile.ZIP_DEFLATED, 9)


def unpack_images(
    path: str | Path,
    sets: Mapping[str, str | Path],
    steps: Mapping[str, Sequence[int]] | None = None,
    progress: Progress | None = None,
) -> None:
    """Write packed images beside the transforms.json that each set gets.

    Args:
        path: of the packed file.
        sets: name of a set -> its transforms.json.
        steps: simulation steps that a set must have, in ascending order; sets that are not named may have any.
        progress: called with the number of written images and of all.

    Raises:
        InputError: the file is missing, damaged, foreign or of other steps; or another image has the name of one.
    """
    _check_there(path)
    try:
        with zipfile.ZipFile(path) as archive:
            if sum(info.compress_size for info in archive.infolist()) > Path(path).stat().st_size:
                raise InputError(f"{path} is damaged: its members overlap or are cut off: copy it again")
            packed = {name: _packed_set(path, archive, name) for name in sets}
            for name, wanted in (steps or {}).items():
                _check_steps(path, sorted({frame.get("step", 0) for frame in packed[name]["frames"]}), wanted)
            total, done = sum(len(transforms["frames"]) for transforms in packed.values()), 0
            for name, target in sets.items():
                target = Path(target)
                # a folder without transforms.json is an unfinished one
                target.unlink(missing_ok=True)
                for frame in packed[name]["frames"]:
                    _unpack_image(
                        path, archive, f"{name}/{frame['file_path']}", frame["sha256"], target.parent
                    )
                    done += 1
                    if progress is not None:
                        progress(done, total)
                write_json(target, packed[name])
    except (zipfile.BadZipFile, zlib.error, EOFError, RuntimeError, ValueError, OSError) as error:
        # what a reader finds wrong has no errno; a full disk does, and is not the file's fault
        if isinstance(error, InputError) or getattr(error, "errno", None):
            raise
        raise InputError(
            f"{path} is damaged, truncated or no packed dataset ({one_line(error)}): copy it again, or pack the scene"
            " again"
        ) from None


def _packed_set(path: str | Path, archive: zipfile.ZipFile, name: str) -> dict[str, Any]:
    """The transforms.json of a set, whose images are all in the archive under names that are safe to write."""
    member = f"{name}/transforms.json"
    if member not in archive.namelist():
        raise InputError(
            f"{path} has no {member}: it is no packed dataset of this version: pack the scene again"
        )
    where = f"{path}: {member}"
    transforms = checked_transforms(parse_json(_content(path, archive, member, MAX_TRANSFORMS), where), where)
    names = set()
    for frame in transforms["frames"]:
        image = frame["file_path"]
        if not IMAGE_NAME.fullmatch(image) or image in names:
            raise InputError(f"{where}: {image} is listed twice or no plain image name: do not use this file")
        if f"{name}/{image}" not in archive.NameToInfo or not frame.get("sha256"):
            raise InputError(f"{path} lacks the image {name}/{image}, or its sha256: copy it again")
        names.add(image)
    return transforms


def _content(path: str | Path, archive: zipfile.ZipFile, member: str, limit: int) -> bytes:
    """Bytes of a member, which are at most ``limit``, whatever its header says."""
    info = archive.getinfo(member)
    # the other methods of ZIP have no bound on what a block of them unpacks to
    if info.file_size > limit or info.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
        raise InputError(
            f"{path}: {member} is larger than {limit} bytes or oddly compressed: do not use this file"
        )
    return archive.read(info)


def _unpack_image(path: str | Path, archive: zipfile.ZipFile, member: str, sha256: str, folder: Path) -> None:
    # an image is stored: its size is that of its part of the archive
    content = _content(path, archive, member, archive.getinfo(member).compress_size)
    if hashlib.sha256(content).hexdigest() != sha256:
        raise InputError(f"{path}: {member} is not what was packed: copy the file again")
    open_image(content, f"{path}: {member}").close()
    target = folder / Path(member).name
    if target.exists() or target.is_symlink():
        if not target.is_file() or target.read_bytes() != content:
            raise InputError(
                f"{target} is there already, with other content than in {path}: remove its folder"
            )
        return
    with atomic(target) as partial:
        partial.write_bytes(content)


# ----------------------------------------------------------------------------------------------- ground truth


def pack_truth(
    path: str | Path, particles_file: str | Path, *, particles: int, deformations: int, seed: int
) -> None:
    """Pack a ground truth.

    Args:
        path: of the packed file.
        particles_file: the particles.h5 of a scene.
        particles: particles to keep, at most.
        deformations: those of them whose F is kept.
        seed: of the choice.
    """
    names = ("frames", "time", "vol0", "mass", "x", "F", "tracers", "tracers_again")
    arrays, attributes = read_arrays(particles_file, required=names, only=names)
    count = arrays["x"].shape[1]
    drawn = np.random.default_rng(seed).permutation(count)
    chosen = np.sort(drawn[:particles])  # neighbours in the file move alike, which compresses
    scale = count / len(chosen)
    for name in ("vol0", "mass"):
        arrays[name] = (scale * arrays[name][chosen].astype(np.float64)).astype(np.float32)
    arrays["x"], arrays["F"] = arrays["x"][:, chosen], arrays["F"][:, np.sort(drawn[:deformations])]
    attributes["packed"] = json.dumps({"particles": len(chosen), "of": count, "rounded_to": STEPS})
    # this version of the format has checksums of all but the data, which gzip adds
    with atomic(path) as partial, h5py.File(partial, "w", track_order=True, libver=VERSION) as file:
        file.attrs.update({"format": FORMAT, **attributes})
        for name in names:
            array, options = arrays[name], {"compression": "gzip", "compression_opts": 9, "shuffle": True}
            if name in STEPS:
                # a chunk a component: its values are of one size
                shape = array.shape
                array, options["chunks"] = _encoded(array, STEPS[name]), (*shape[:2], *[1] * (len(shape) - 2))
            file.create_dataset(name, data=array, track_times=False, **options)


def unpack_truth(
    path: str | Path,
    particles_file: str | Path,
    steps: Sequence[int] | None = None,
    dt: float | None = None,
) -> None:
    """Write a packed ground truth as particles.h5.

    Args:
        path: of the packed file.
        particles_file: to write.
        steps: simulation steps that its frames must have.
        dt: time step that it must have been simulated with [s].

    Raises:
        InputError: the file is missing, damaged, foreign, of another version or of other steps.
    """
    _check_there(path)
    names = ("frames", "time", "vol0", "mass", "x", "F", "tracers", "tracers_again")
    arrays, attributes = read_arrays(path, only=names)
    if (found := attributes.pop("format", None)) != FORMAT:
        raise InputError(
            f"{path} holds {one_line(found)}, not {FORMAT}: give the other file, or pack the scene again"
        )
    if missing := [name for name in names if name not in arrays]:
        raise InputError(
            f"{path} has no dataset {', '.join(missing)}: copy it again, or pack the scene again"
        )
    if steps is not None:
        _check_steps(path, arrays["frames"].tolist(), steps)
    if dt is not None and attributes.get("dt") != dt:
        raise InputError(
            f"{path} was simulated with dt = {attributes.get('dt')} s, the scene has {dt} s: use the"
            " settings that it was made with, or pack the scene again"
        )
    for name, step in STEPS.items():
        if arrays[name].dtype != np.uint32 or arrays[name].ndim < 3:
            raise InputError(f"{path}: {name} is not packed as {FORMAT} says: pack the scene again")
        arrays[name] = _decoded(arrays[name], step)
    write_arrays(particles_file, {name: arrays[name] for name in names}, attributes)


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


def _check_there(path: str | Path) -> None:
    if not Path(path).is_file():
        raise InputError(f"{path} does not exist: put the packed file there, or set dataset.packed: null")


def _check_steps(path: str | Path, found: Sequence[int], wanted: Sequence[int]) -> None:
    if list(found) != list(wanted):
        raise InputError(
            f"{path} has {len(found)} frames at steps {_brief(found)}, the settings ask for {len(wanted)} at"
            f" {_brief(wanted)}: use the settings that it was made with (dataset.steps, dataset.stride, dataset.frames)"
        )


def _brief(steps: Sequence[int]) -> str:
    return ", ".join(map(str, steps)) if len(steps) < 5 else f"{steps[0]}, {steps[1]}, ..., {steps[-1]}"
