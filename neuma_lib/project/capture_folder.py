"""The folder of a capture: settings, photographs, stills and videos."""

from collections.abc import Iterable
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path

from neuma_lib.config.capture import CaptureConfig
from neuma_lib.config.validation import hint, validate, with_advanced
from neuma_lib.config.variants import NAME
from neuma_lib.errors import InputError
from neuma_lib.io.files import one_line
from neuma_lib.io.yaml_files import load_yaml

PHOTOGRAPHS = "photographs"  # group of the photographs. Other groups are named after cameras.
PICTURES = (".jpg", ".jpeg", ".png", ".webp")
VIDEOS = (".mp4", ".mov", ".m4v", ".mkv", ".avi", ".webm")
HEIF = (".heic", ".heif")  # photographs that the package pillow-heif decodes
OTHER_PICTURES = (".dng", ".cr2", ".nef", ".arw")
"""Formats of cameras that are not supported. They cause an error, so that no photograph is silently ignored."""


@dataclass(frozen=True)
class Capture:
    """Files of a capture."""

    folder: Path  # root of the capture
    settings: CaptureConfig  # its capture.yaml
    photographs: tuple[Path, ...]  # pictures of the object, sorted by name, possibly none yet
    stills: dict[str, Path]  # camera -> its picture of the empty scene
    takes: dict[str, dict[str, Path]]  # take -> camera -> video, cameras sorted by name, possibly none yet
    body: str | None = None  # one of its several bodies. None for all, or the only one.

    @property
    def name(self) -> str:
        """Folder of its results: of the capture, or of one of its bodies."""
        return self.folder.name + (f"_{self.body}" if self.body else "")

    @property
    def source(self) -> str:
        """Folder of the results with the reconstruction from photographs: its own, or that of another capture."""
        return self.body and self.settings.bodies[self.body].capture or self.name

    @property
    def labels(self) -> dict[str, int | str]:
        """Labels of all bodies in masks. Empty for one body."""
        return {name: body.label for name, body in self.settings.bodies.items()}

    def pictures(self) -> dict[str, tuple[Path, ...]]:
        """Photographs and stills, by group. Raises InputError if photographs, or the still of a camera, are missing."""
        if not self.photographs:
            problem = f"no photographs ({', '.join(PICTURES)})"
            raise InputError(self.folder / self.settings.photographs, problem, "Put them there")
        filmed = {camera for videos in self.takes.values() for camera in videos}
        for camera in sorted(filmed - self.stills.keys()):
            raise InputError(
                self.folder / self.settings.stills,
                f"no picture of the empty scene for the camera '{camera}'",
                f"Film the scene for a second without the object, and save a frame as {camera}.png",
            )
        return {PHOTOGRAPHS: self.photographs, **{camera: (file,) for camera, file in self.stills.items()}}

    def video(self, take: str, camera: str) -> Path:
        """The video of a take by a camera. Raises InputError if there is none."""
        if camera not in self.cameras_of(take):
            problem = f"no video of '{take}' by '{camera}'{hint(camera, self.takes[take])}"
            raise InputError(self.folder, problem)
        return self.takes[take][camera]

    def cameras_of(self, take: str) -> tuple[str, ...]:
        """Cameras of a take, by name. Raises InputError if there is no such take."""
        if not self.takes:
            raise _no_videos(self.folder / "videos")
        if take not in self.takes:
            raise InputError(self.folder, f"no take '{take}'{hint(take, self.takes)}")
        return tuple(self.takes[take])

    def own_masks(self, name: str) -> dict[str, Path]:
        """Masks of the user in a subfolder, by file stem.

        Raises:
            InputError: two masks of one picture, or none for pictures of several bodies.
        """
        masks = _by_stem(self.folder, f"{self.settings.masks}/{name}", PICTURES)
        if self.settings.bodies and not masks:
            where = self.folder / self.settings.masks / name
            raise InputError(where, "no masks, which several bodies need", "Put label images there as PNG")
        return masks


def _no_videos(folder: Path) -> InputError:
    return InputError(
        folder, f"no videos ({', '.join(VIDEOS)})", "Put one there for each camera, <camera>.mp4"
    )


def capture_folders(root: str | Path) -> list[Path]:
    """The folders of all captures below a folder, sorted, without hidden ones. Empty if it does not exist."""
    folders = Path(root).iterdir() if Path(root).is_dir() else ()
    return sorted(p for p in folders if p.is_dir() and not p.name.startswith("."))


def read_settings(path: str | Path) -> CaptureConfig:
    """Settings of a capture.yaml. Raises InputError with each invalid, missing or unknown key."""
    raw = load_yaml(path, "Create it as in the example of docs/capture.md")
    try:
        return validate(
            CaptureConfig, with_advanced(CaptureConfig, raw) if isinstance(raw, dict) else raw or {}
        )
    except InputError as error:
        raise InputError(path, str(error)) from None


def inside(folder: str | Path, name: str | Path) -> Path:
    """A path below a capture's folder. Raises InputError if a link or ".." leads out of it."""
    root = Path(folder).resolve()
    path = (root / name).resolve()
    if path != root and root not in path.parents:
        problem = f"it is outside the capture's folder {folder}"
        raise InputError(Path(folder) / name, problem, "Copy the file there")
    return Path(folder) / name


def read_capture(folder: str | Path) -> Capture:
    """Settings and files of a capture, of which some may still be missing.

    Raises:
        InputError: see `read_settings` and `inside`; a take without videos; settings of an unknown camera; two files
            for one camera; invalid names.
    """
    folder = Path(folder)
    source = folder / "capture.yaml"
    settings = read_settings(source)
    photographs = _pictures(folder, settings.photographs)
    if settings.throws:
        takes = {name: _by_stem(folder, take.folder, VIDEOS) for name, take in settings.throws.items()}
    else:
        takes = _default_takes(folder)
    for name, videos in takes.items():
        if not videos:
            take = settings.throws.get(name)
            raise _no_videos(folder / (take.folder if take else f"videos/{name}"))
    stills = _by_stem(folder, settings.stills, PICTURES)
    cameras = sorted({camera for videos in takes.values() for camera in videos} | stills.keys())
    for camera in settings.cameras:
        if camera not in cameras:
            problem = f"no video or still has this name{hint(camera, cameras)}"
            raise InputError(f"{source}: cameras.{camera}", problem)
    for name in (*cameras, *takes):
        if not NAME.fullmatch(name):
            problem = f"'{one_line(name)}' cannot name folders and results"
            raise InputError(folder, problem, "Rename it, with letters, digits, - and _")
    if PHOTOGRAPHS in cameras:
        raise InputError(folder, f"a video camera cannot be named '{PHOTOGRAPHS}'", "Rename its files")
    names = [file.name for file in photographs]
    length = settings.length
    marked = {
        "length.ends": length.ends if length else (),
        "length.cameras": length.cameras or () if length else (),
        "object": settings.object,
    }
    for key, name in ((key, name) for key, files in marked.items() for name in files):
        if name not in names:
            raise InputError(f"{source}: {key}.{name}", f"no such photograph{hint(name, names)}")
    return Capture(folder, settings, photographs, stills, takes)


def _default_takes(folder: Path) -> dict[str, dict[str, Path]]:
    """The videos in `videos`, or one take for each of its folders."""
    direct = _by_stem(folder, "videos", VIDEOS)
    below = sorted(p for p in _listed(folder, "videos") if p.is_dir())
    if direct and below:
        raise InputError(
            folder / "videos",
            "it contains both videos and folders",
            "Put the videos of each take into a folder, or list the takes under `throws` in capture.yaml",
        )
    if below:
        return {p.name: _by_stem(folder, f"videos/{p.name}", VIDEOS) for p in below}
    return {"first": direct} if direct else {}


def _listed(folder: Path, name: str) -> list[Path]:
    """Sorted content of a folder without hidden files. Empty if the folder does not exist."""
    path = inside(folder, name)
    files = sorted(p for p in path.iterdir() if not p.name.startswith(".")) if path.is_dir() else []
    return [inside(folder, p.relative_to(folder)) for p in files]


def _pictures(folder: Path, name: str) -> tuple[Path, ...]:
    decoded = HEIF if find_spec("pillow_heif") else ()
    for file in _listed(folder, name):
        suffix = file.suffix.lower()
        if suffix in HEIF and not decoded:
            problem = "the decoder of HEIC pictures is not installed"
            raise InputError(
                file, problem, "Run `pip install pillow-heif`, or convert it to JPEG and remove it"
            )
        if suffix in OTHER_PICTURES:
            problem = "this picture format is not supported"
            raise InputError(file, problem, "Convert it to JPEG, and remove it")
    return tuple(_by_stem(folder, name, (*PICTURES, *decoded)).values())


def _by_stem(folder: Path, name: str, suffixes: Iterable[str]) -> dict[str, Path]:
    """Files of a folder with one of the suffixes, by their stem: a photograph, a camera or a frame."""
    files: dict[str, Path] = {}
    for file in _listed(folder, name):
        if file.is_file() and file.suffix.lower() in suffixes:
            if file.stem in files:
                problem = f"{files[file.stem].name} has the same name with another suffix"
                raise InputError(file, problem, "Remove or rename one of the two")
            files[file.stem] = file
    return files
