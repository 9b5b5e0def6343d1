"""Released captures: which of their files show an object. `neuma_lib.capture.released` reads them."""

from collections.abc import Mapping
from pathlib import Path

from neuma_lib.config.capture import ReleasedConfig
from neuma_lib.config.validation import hint
from neuma_lib.errors import InputError
from neuma_lib.io.files import existing, read_json
from neuma_lib.project.capture_folder import Capture

TAKE = "first"  # name of the only take
GROUND = {"bun": -0.010, "burger": -0.025, "dog": -0.025, "pig": -0.025, "potato": -0.010}
"""z of the floor under each object in Spring-Gaus' settings."""
UNPACK = "Unpack the archive again"


def released_captures(released: Mapping[str, ReleasedConfig]) -> dict[str, Capture]:
    """Released captures of the settings, in the form of `neuma_lib.project.capture_folder.read_capture`.

    Raises:
        InputError: see `object_folder`, `floor_height` and `sequence`.
    """
    captures = {}
    for name, settings in released.items():
        object_name = settings.object or name
        floor_height(object_name, settings.ground)
        folder, is_spring_gaus = object_folder(settings.folder, object_name)
        calibration = folder / "cameras_calib.json"
        cameras = (
            sequence(folder, object_name)[0] if is_spring_gaus else read_json(existing(calibration, UNPACK))
        )
        videos = dict.fromkeys(sorted(cameras), folder)
        captures[name] = Capture(Path(name), settings.as_capture(), (), {}, {TAKE: videos})
    return captures


def object_folder(folder: str | Path, name: str) -> tuple[Path, bool]:
    """Folder with the files of an object, and whether its layout is that of Spring-Gaus instead of NeuMA."""
    folder = Path(folder)
    if (folder / "dynamic/sequences").is_dir():
        return folder, True
    for own in (folder / name, folder):
        if (own / "dynamics").is_dir():
            return own, False
    raise InputError(
        folder,
        f"the layout is neither that of Spring-Gaus (dynamic/sequences/) nor that of NeuMA ({name}/dynamics/)",
        "Give the folder that contains one of these",
    )


def floor_height(name: str, ground: float | None) -> float:
    """z of the floor: the given one, or that of an object in Spring-Gaus' settings."""
    if ground is None and name not in GROUND:
        problem = "the floor of this object is unknown"
        raise InputError(name, problem, "Set `ground`, z of the floor in the world of the files")
    return GROUND[name] if ground is None else ground


def sequence(folder: Path, name: str) -> tuple[dict[str, list[str]], int | None]:
    """Spring-Gaus' list of an object: camera -> names of its frames, and the first frame of contact if it is given."""
    sequences = folder / "dynamic/sequences"
    if not (sequences / name).is_dir():
        raise InputError(sequences, f"no object '{name}'{hint(name, [p.name for p in sequences.iterdir()])}")
    path = sequences / name / "0.json"
    frames = read_json(existing(path, UNPACK))
    contact = frames.pop("hit_frame", None)
    if contact is not None and (type(contact) is not int or contact < 0):
        raise InputError(f"{path}: hit_frame", f"{contact!r} must be the number of a frame")
    for camera, files in frames.items():
        if not isinstance(files, list) or not all(isinstance(file, str) for file in files):
            raise InputError(f"{path}: {camera}", "expected a list of names of pictures")
        if not files:
            raise InputError(f"{path}: {camera}", "it has no pictures", UNPACK)
    return frames, contact
