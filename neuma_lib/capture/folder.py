"""The folder of a capture: its settings, and which photographs, stills and videos lie where."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import yaml

from neuma_lib.config.capture import CaptureConfig
from neuma_lib.config.validation import hint, validate
from neuma_lib.errors import InputError
from neuma_lib.io.files import existing, reading

PHOTOGRAPHS = "photographs"
"""Group of the photographs, beside the names of the cameras."""
PICTURES = (".jpg", ".jpeg", ".png", ".webp")
VIDEOS = (".mp4", ".mov", ".m4v", ".mkv", ".avi", ".webm")
OTHER_PICTURES = (".heic", ".heif", ".dng", ".cr2", ".nef", ".arw")
"""What cameras write and nothing here reads; a photograph left out in silence would be worse than a message."""


@dataclass(frozen=True)
class Capture:
    """Files of a capture.

    Attributes:
        folder: where all of it lies.
        settings: its capture.yaml.
        photographs: pictures of the object, by name.
        stills: camera -> its picture of the empty scene.
        throws: throw -> camera -> video; cameras in the order of their names.
    """

    folder: Path
    settings: CaptureConfig
    photographs: tuple[Path, ...]
    stills: dict[str, Path]
    throws: dict[str, dict[str, Path]]

    @property
    def cameras(self) -> tuple[str, ...]:
        """All cameras that filmed, by name."""
        return tuple(sorted({camera for videos in self.throws.values() for camera in videos}))


def read_settings(path: str | Path) -> CaptureConfig:
    """Settings of a capture.yaml.

    Raises:
        InputError: names the file, and each key that is wrong, missing or unknown.
    """
    content = existing(path, "a capture needs one; docs/capture.md has an example").read_bytes()
    with reading(path, "YAML"):
        raw = yaml.safe_load(content)
    try:
        return validate(CaptureConfig, {} if raw is None else raw)
    except InputError as error:
        raise InputError(f"{path}: {str(error).removeprefix('settings: ')}") from None


def inside(folder: str | Path, name: str | Path) -> Path:
    """A path below a capture's folder.

    Raises:
        InputError: it leads out of the folder, if only through a link.
    """
    root = Path(folder).resolve()
    path = (root / name).resolve()
    if path != root and root not in path.parents:
        raise InputError(
            f"{Path(folder) / name} leads out of the capture's folder {folder}: copy the file there"
        )
    return Path(folder) / name


def read_capture(folder: str | Path) -> Capture:
    """Settings and files of a capture.

    Raises:
        InputError: see `read_settings` and `inside`; no photographs or videos; a camera without a picture of the empty
            scene; settings of a camera that did not film; two files for one camera.
    """
    folder = Path(folder)
    source = folder / "capture.yaml"
    settings = read_settings(source)
    photographs = _pictures(folder, settings.photographs)
    if not photographs:
        raise InputError(
            f"{folder / settings.photographs} has no photographs ({', '.join(PICTURES)}): put them there"
        )
    if settings.throws:
        throws = {name: _by_camera(folder, throw.folder, VIDEOS) for name, throw in settings.throws.items()}
    else:
        throws = _default_throws(folder)
    for name, videos in throws.items():
        if not videos:
            where = settings.throws[name].folder if name in settings.throws else "videos"
            raise InputError(
                f"{folder / where} has no videos ({', '.join(VIDEOS)}): put one there for each camera, <camera>.mp4"
            )
    cameras = sorted({camera for videos in throws.values() for camera in videos})
    for camera in settings.cameras:
        if camera not in cameras:
            raise InputError(f"{source}: cameras.{camera}: no video is named so{hint(camera, cameras)}")
    if PHOTOGRAPHS in cameras:
        raise InputError(f"{folder}: a video camera cannot be named '{PHOTOGRAPHS}': rename its files")
    stills = _by_camera(folder, settings.stills, PICTURES)
    if settings.length:
        names = [file.name for file in photographs]
        for name in settings.length.ends:
            if name not in names:
                raise InputError(
                    f"{source}: length.ends.{name}: there is no such photograph{hint(name, names)}"
                )
    for camera in cameras:
        if camera not in stills:
            raise InputError(
                f"{folder / settings.stills} has no picture of the empty scene for the camera '{camera}': film a "
                f"second before the object is there, and save a frame of it as {camera}.png"
            )
    return Capture(folder, settings, photographs, {c: stills[c] for c in cameras}, throws)


def _default_throws(folder: Path) -> dict[str, dict[str, Path]]:
    """The videos in `videos`; or one throw for each of its folders."""
    direct = _by_camera(folder, "videos", VIDEOS)
    below = sorted(p for p in _listed(folder, "videos") if p.is_dir())
    if direct and below:
        raise InputError(
            f"{folder / 'videos'} has videos and folders: put each throw into a folder of its own, or name them under "
            "'throws' in capture.yaml"
        )
    if below:
        return {p.name: _by_camera(folder, f"videos/{p.name}", VIDEOS) for p in below}
    return {"first": direct}


def _listed(folder: Path, name: str) -> list[Path]:
    """What lies in a folder, by name and without hidden files; nothing where there is no such folder."""
    path = inside(folder, name)
    found = sorted(p for p in path.iterdir() if not p.name.startswith(".")) if path.is_dir() else []
    return [inside(folder, p.relative_to(folder)) for p in found]


def _pictures(folder: Path, name: str) -> tuple[Path, ...]:
    found = _listed(folder, name)
    for file in found:
        if file.suffix.lower() in OTHER_PICTURES:
            raise InputError(f"{file}: pictures of this kind are not read: convert it to JPEG, and remove it")
    pictures = [file for file in found if file.suffix.lower() in PICTURES]
    for i, file in enumerate(pictures):
        if file.stem in [other.stem for other in pictures[:i]]:
            raise InputError(
                f"{file}: another picture differs from it in its ending only: rename one of them"
            )
    return tuple(pictures)


def _by_camera(folder: Path, name: str, suffixes: Iterable[str]) -> dict[str, Path]:
    files: dict[str, Path] = {}
    for file in _listed(folder, name):
        if file.is_file() and file.suffix.lower() in suffixes:
            if file.stem in files:
                raise InputError(f"{file}: {files[file.stem].name} is of the same camera: remove one of them")
            files[file.stem] = file
    return files
