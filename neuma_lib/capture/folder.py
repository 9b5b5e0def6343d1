"""The folder of a capture: its settings, and which photographs, stills and videos lie where."""

from __future__ import annotations

import re
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import yaml

from neuma_lib.config.capture import CaptureConfig
from neuma_lib.config.validation import hint, validate
from neuma_lib.errors import InputError
from neuma_lib.io.files import existing, one_line, reading

NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_-]*")
"""What captures, throws and cameras may be named, since results are named after them."""
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
        photographs: pictures of the object, by name; there may be none yet.
        stills: camera -> its picture of the empty scene.
        throws: throw -> camera -> video; cameras in the order of their names. There may be none yet.
    """

    folder: Path
    settings: CaptureConfig
    photographs: tuple[Path, ...]
    stills: dict[str, Path]
    throws: dict[str, dict[str, Path]]

    def pictures(self) -> dict[str, tuple[Path, ...]]:
        """Photographs and stills, by group.

        Raises:
            InputError: there are no photographs, or no picture of the empty scene for a camera that filmed.
        """
        if not self.photographs:
            raise InputError(
                f"{self.folder / self.settings.photographs} has no photographs ({', '.join(PICTURES)}): put them there"
            )
        for camera in sorted(
            {camera for videos in self.throws.values() for camera in videos} - self.stills.keys()
        ):
            raise InputError(
                f"{self.folder / self.settings.stills} has no picture of the empty scene for the camera '{camera}': "
                f"film a second before the object is there, and save a frame of it as {camera}.png"
            )
        return {PHOTOGRAPHS: self.photographs, **{camera: (file,) for camera, file in self.stills.items()}}

    def video(self, throw: str, camera: str) -> Path:
        """The video of a throw by a camera. Raises InputError where there is none."""
        if camera not in self.cameras_of(throw):
            videos = self.throws[throw]
            raise InputError(f"{self.folder}: no video of '{throw}' by '{camera}'{hint(camera, videos)}")
        return self.throws[throw][camera]

    def cameras_of(self, throw: str) -> tuple[str, ...]:
        """Cameras that filmed a throw, by name. Raises InputError where there is no such throw."""
        if not self.throws:
            raise _no_videos(self.folder / "videos")
        if throw not in self.throws:
            raise InputError(f"{self.folder} has no throw '{throw}'{hint(throw, self.throws)}")
        return tuple(self.throws[throw])

    def own_masks(self, name: str) -> dict[str, Path]:
        """Own masks in a folder of those of the capture, by the stem of their files.

        Raises:
            InputError: two masks of one picture, or a path out of the capture.
        """
        return _by_camera(self.folder, f"{self.settings.masks}/{name}", PICTURES)


def _no_videos(folder: Path) -> InputError:
    return InputError(
        f"{folder} has no videos ({', '.join(VIDEOS)}): put one there for each camera, <camera>.mp4"
    )


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
    """Settings and files of a capture, of which some may still be missing.

    Raises:
        InputError: see `read_settings` and `inside`; a throw without videos; settings of a camera that is not there;
            two files for one camera.
    """
    folder = Path(folder)
    source = folder / "capture.yaml"
    settings = read_settings(source)
    photographs = _pictures(folder, settings.photographs)
    if settings.throws:
        throws = {name: _by_camera(folder, throw.folder, VIDEOS) for name, throw in settings.throws.items()}
    else:
        throws = _default_throws(folder)
    for name, videos in throws.items():
        if not videos:
            raise _no_videos(
                folder / (settings.throws[name].folder if name in settings.throws else f"videos/{name}")
            )
    stills = _by_camera(folder, settings.stills, PICTURES)
    filmed = {camera for videos in throws.values() for camera in videos}
    cameras = sorted(filmed | stills.keys())
    for camera in settings.cameras:
        if camera not in cameras:
            raise InputError(
                f"{source}: cameras.{camera}: no video or still is named so{hint(camera, cameras)}"
            )
    for name in (*cameras, *throws):
        if not NAME.fullmatch(name):
            raise InputError(
                f"{folder}: '{one_line(name)}' is to name folders and results: rename it, with letters, digits, - and _"
            )
    if PHOTOGRAPHS in cameras:
        raise InputError(f"{folder}: a video camera cannot be named '{PHOTOGRAPHS}': rename its files")
    if settings.length:
        names = [file.name for file in photographs]
        for name in settings.length.ends:
            if name not in names:
                raise InputError(
                    f"{source}: length.ends.{name}: there is no such photograph{hint(name, names)}"
                )
    return Capture(folder, settings, photographs, stills, throws)


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
    return {"first": direct} if direct else {}


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
