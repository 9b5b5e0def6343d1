"""A scene's dataset as two small files that travel: its images, without loss, and the ground truth that is compared.

Images: each is cropped to the box of what differs from its background (the colour of its first pixel) and kept as
lossless WebP, with its camera, step and time. Unpacked, every pixel of RGBA is what it was, hidden colours too; this is
checked against a digest of the pixels.

Ground truth: positions as multiples of 2^-14 m (61 um: at most 31 um off along an axis, 1e-9 m^2 in the mean square),
elastic deformation gradients as multiples of 2^-16, everything else exactly. All tracers stay; of the particles a
random part does, with volumes and masses scaled up to the same total. Velocities are left out.

Both are ZIP archives with a ``manifest.json``, so any archive program opens them; the same data give the same bytes.
"""

from __future__ import annotations

import hashlib
import io
import json
import zipfile
import zlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from neuma_lib.errors import InputError
from neuma_lib.io.files import atomic
from neuma_lib.io.hdf5 import read_arrays, write_arrays
from neuma_lib.io.images import read_image_set, read_transforms, write_transforms

VERSION = 1
IMAGES, TRUTH = "NeuMA images", "NeuMA ground truth"
STEPS = {"x": 2.0**-14, "tracers": 2.0**-14, "tracers_again": 2.0**-14, "F": 2.0**-16}
"""What a quantity is rounded to multiples of [m; F: 1]; others are kept exactly."""

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
    manifest: dict[str, Any] = {"sets": {}}
    found = {name: (read_transforms(file), read_image_set(file).images) for name, file in sets.items()}
    for name, (transforms, _) in found.items():
        stems = [Path(frame["file_path"]).stem for frame in transforms["frames"]]
        if len(set(stems)) < len(stems):
            twice = next(stem for stem in stems if stems.count(stem) > 1)
            raise InputError(f"{sets[name]} lists several images named {twice}: rename them")
    total, done = sum(len(images) for _, images in found.values()), 0
    with _writing(path, IMAGES, manifest) as archive:
        for name, (transforms, images) in found.items():
            frames = []
            for frame, image in zip(transforms["frames"], images, strict=True):
                box, crop = _cropped(image)
                member, stem = io.BytesIO(), Path(frame["file_path"]).stem
                Image.fromarray(crop).save(member, "WEBP", lossless=True, exact=True, quality=75, method=4)
                _write_member(archive, f"{name}/{stem}.webp", member.getvalue())
                kept = {key: value for key, value in frame.items() if key not in ("file_path", "sha256")}
                own = {"box": box, "background": image[0, 0].tolist(), "pixels": _digest(image)}
                frames.append({"file_path": f"{stem}.png", **kept, **own})
                done += 1
                if progress is not None:
                    progress(done, total)
            manifest["sets"][name] = {**transforms, "size": images.shape[2:0:-1], "frames": frames}


def unpack_images(
    path: str | Path,
    sets: Mapping[str, str | Path],
    steps: Mapping[str, Sequence[int]] | None = None,
    progress: Progress | None = None,
) -> None:
    """Write packed images as PNG files beside the transforms.json that each set gets.

    Args:
        path: of the packed file.
        sets: name of a set -> its transforms.json.
        steps: simulation steps that a set must have, in ascending order; sets that are not named may have any.
        progress: called with the number of written images and of all.

    Raises:
        InputError: the file is missing, damaged, foreign, of another version or of other steps.
    """
    with _reading(path, IMAGES) as (archive, manifest):
        packed = {name: manifest["sets"][name] for name in sets if name in manifest["sets"]}
        if missing := [name for name in sets if name not in packed]:
            raise InputError(f"{path} has no images {', '.join(missing)}: pack the scene again")
        for name, wanted in (steps or {}).items():
            _check_steps(path, sorted({frame.get("step", 0) for frame in packed[name]["frames"]}), wanted)
        total, done = sum(len(transforms["frames"]) for transforms in packed.values()), 0
        for name, target in sets.items():
            transforms, target = packed[name], Path(target)
            # a folder without transforms.json is an unfinished one
            target.unlink(missing_ok=True)
            frames = []
            for frame in transforms["frames"]:
                image = _restored(path, archive, name, frame, transforms["size"])
                with atomic(target.parent / frame["file_path"]) as partial:
                    Image.fromarray(image).save(partial, "PNG")
                own = ("box", "background", "pixels")
                frames.append({key: value for key, value in frame.items() if key not in own})
                done += 1
                if progress is not None:
                    progress(done, total)
            shared = {key: value for key, value in transforms.items() if key not in ("frames", "size")}
            write_transforms(target, shared, frames)
            read_transforms(target)


def _cropped(image: np.ndarray) -> tuple[list[int], np.ndarray]:
    """Box (left, top, right, bottom) of all that differs from the first pixel, and the image inside."""
    different = (image != image[0, 0]).any(axis=2)
    rows, columns = np.flatnonzero(different.any(axis=1)), np.flatnonzero(different.any(axis=0))
    top, bottom, left, right = (*rows[[0, -1]], *columns[[0, -1]]) if len(rows) else (0, 0, 0, 0)
    box = [int(left), int(top), int(right) + 1, int(bottom) + 1]
    return box, np.ascontiguousarray(image[box[1] : box[3], box[0] : box[2]])


def _restored(path, archive, name: str, frame: Mapping[str, Any], size: Sequence[int]) -> np.ndarray:
    """A whole image (H, W, 4), with the pixels that were packed."""
    file = frame["file_path"]
    if Path(file).name != file:
        raise InputError(f"{path} names an image outside its folder ({file}): do not use this file")
    with Image.open(io.BytesIO(archive.read(f"{name}/{Path(file).stem}.webp"))) as webp:
        crop = np.asarray(webp.convert("RGBA"))
    left, top, right, bottom = frame["box"]
    image = np.empty((size[1], size[0], 4), dtype=np.uint8)
    image[:] = frame["background"]
    image[top:bottom, left:right] = crop
    if _digest(image) != frame["pixels"]:
        raise InputError(f"{path}: the pixels of {name}/{file} are not those that were packed: copy it again")
    return image


def _digest(image: np.ndarray) -> str:
    return hashlib.sha256(np.ascontiguousarray(image).tobytes()).hexdigest()


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
    attributes["packed"] = json.dumps(
        {"particles": len(chosen), "of": count, "rounded_to": {name: STEPS[name] for name in STEPS}}
    )
    manifest = {
        "attributes": attributes,
        "arrays": {
            name: {"shape": arrays[name].shape, "dtype": arrays[name].dtype.str, "step": STEPS.get(name)}
            for name in names
        },
    }
    with _writing(path, TRUTH, manifest) as archive:
        for name in names:
            data = _encoded(arrays[name], STEPS.get(name))
            _write_member(archive, name, data, zipfile.ZIP_BZIP2)


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
    with _reading(path, TRUTH) as (archive, manifest):
        arrays = {
            name: _decoded(archive.read(name), kind["shape"], np.dtype(kind["dtype"]), kind["step"])
            for name, kind in manifest["arrays"].items()
        }
        if steps is not None:
            _check_steps(path, arrays["frames"].tolist(), steps)
        if dt is not None and manifest["attributes"]["dt"] != dt:
            raise InputError(
                f"{path} was simulated with dt = {manifest['attributes']['dt']} s, the scene has {dt} s: use the"
                " settings that it was made with, or pack the scene again"
            )
        write_arrays(particles_file, arrays, manifest["attributes"])


def _encoded(array: np.ndarray, step: float | None) -> bytes:
    """Bytes that compress well: differences in time of whole multiples of ``step``, the lowest bytes of all first."""
    if step is None:
        return array.astype(array.dtype.newbyteorder("<")).tobytes()
    whole = np.rint(array.reshape(len(array), array.shape[1], -1) / step).astype(np.int32)
    change = np.diff(whole, axis=0, prepend=np.int32(0))
    unsigned = ((change << 1) ^ (change >> 31)).astype("<u4")  # small numbers of both signs become small
    by_component = np.ascontiguousarray(np.moveaxis(unsigned, 2, 0))
    return by_component.view(np.uint8).reshape(-1, 4).T.tobytes()


def _decoded(data: bytes, shape: Sequence[int], dtype: np.dtype, step: float | None) -> np.ndarray:
    """The array that `_encoded` was given, up to half a step."""
    if step is None:
        return np.frombuffer(data, dtype=dtype.newbyteorder("<")).reshape(shape).astype(dtype)
    planes = np.frombuffer(data, dtype=np.uint8).reshape(4, -1)
    unsigned = np.ascontiguousarray(planes.T).view("<u4").reshape(-1, *shape[:2])
    change = (unsigned >> 1).astype(np.int32) ^ -(unsigned & 1).astype(np.int32)
    whole = np.moveaxis(np.cumsum(change, axis=1, dtype=np.int32), 0, 2)
    return (whole * step).astype(dtype).reshape(shape)


# --------------------------------------------------------------------------------------------------- archives


@contextmanager
def _writing(path: str | Path, kind: str, manifest: Mapping[str, Any]) -> Iterator[zipfile.ZipFile]:
    """An archive to fill; ``manifest`` is written last, as it is then."""
    with atomic(path) as partial, zipfile.ZipFile(partial, "w") as archive:
        yield archive
        text = json.dumps({"format": kind, "version": VERSION, **manifest}, allow_nan=False)
        _write_member(archive, "manifest.json", text.encode(), zipfile.ZIP_DEFLATED)


def _write_member(archive: zipfile.ZipFile, name: str, data: bytes, compression=zipfile.ZIP_STORED) -> None:
    archive.writestr(zipfile.ZipInfo(name), data, compression, 9)  # ZipInfo: without the time of day


@contextmanager
def _reading(path: str | Path, kind: str) -> Iterator[tuple[zipfile.ZipFile, dict[str, Any]]]:
    """An open archive and its manifest; whatever is wrong with the file becomes an InputError."""
    if not Path(path).is_file():
        raise InputError(f"{path} does not exist: put the packed file there, or set dataset.packed: null")
    try:
        with zipfile.ZipFile(path) as archive:
            manifest = json.loads(archive.read("manifest.json"))
            if manifest.get("format") != kind:
                raise InputError(
                    f"{path} holds {manifest.get('format')!r}, not {kind!r}: give the other file"
                )
            if manifest["version"] != VERSION:
                raise InputError(
                    f"{path} has version {manifest['version']} of the format, this program reads {VERSION}: pack the"
                    " scene again with this version of the program"
                )
            yield archive, manifest
    except (zipfile.BadZipFile, zlib.error, EOFError, KeyError, ValueError, TypeError, OSError) as error:
        # what a reader finds wrong has no errno; a full disk does, and is not the file's fault
        if isinstance(error, InputError) or getattr(error, "errno", None):
            raise
        raise InputError(
            f"{path} is damaged, truncated or no packed dataset ({error}): copy it again, or pack the scene again"
        ) from None


def _check_steps(path: str | Path, found: Sequence[int], wanted: Sequence[int]) -> None:
    if list(found) != list(wanted):
        raise InputError(
            f"{path} has {len(found)} frames at steps {_brief(found)}, the settings ask for {len(wanted)} at"
            f" {_brief(wanted)}: use the settings that it was made with (dataset.steps, dataset.stride, dataset.frames)"
        )


def _brief(steps: Sequence[int]) -> str:
    return ", ".join(map(str, steps)) if len(steps) < 5 else f"{steps[0]}, {steps[1]}, ..., {steps[-1]}"
