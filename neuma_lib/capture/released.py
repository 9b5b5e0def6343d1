"""The real captures of Spring-Gaus and the copy of them by NeuMA's authors, read as they lie in their folders.

Both show an object that is dropped before three fixed cameras at 120 frames a second, with a mask for each frame, in a
world that a checkerboard gives: z points down, the floor is a plane of constant z.

- Spring-Gaus (github.com/Colmar-zlicheng/Spring-Gaus), ``real_capture/``: ``dynamic/cameras_calib.json`` has the pose
  of each camera (OpenCV's rvecs and tvecs), ``dynamic/sequences/<object>/0.json`` the names of its frames and the frame
  of the first contact, ``dynamic/videos_images/<camera>`` and ``videos_masks/<camera>`` the pictures. ``static/`` has
  photographs with masks and COLMAP's cameras, in a world of their own.
- NeuMA (github.com/XJay18/NeuMA), a folder for each object: ``sparse/0/cameras.bin``, ``cameras_calib.json`` with the
  keys r_0, r_1, ..., and ``dynamics/r_<view>_<step>.jpg``, ``dynamic_masks/r_<view>_<step>.png``. No photographs.

Neither file has the intrinsics of the video: both codes take those of the photographs' camera, of 4752 x 2672 pixels,
scaled to the video, with the principal point in the middle and without distortion. So does this module.

The world is not metric. What NeuMA's settings do about it is to let 10 ms pass from frame to frame where the camera let
pass 8.33: gravity then is 1.44 times as strong as it would be in metres.
"""

from __future__ import annotations

import re
import struct
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image
from scipy.ndimage import binary_dilation
from scipy.spatial.transform import Rotation

from neuma_lib.capture.agreement import nearest_point
from neuma_lib.capture.folder import PHOTOGRAPHS, Capture
from neuma_lib.capture.lens import Lens, lens_of_colmap
from neuma_lib.capture.masks import centroid
from neuma_lib.capture.mattes import own_mask
from neuma_lib.capture.pictures import picture_size, read_picture, undistorted
from neuma_lib.capture.placement import Similarity
from neuma_lib.capture.room import BOX_MIDDLE
from neuma_lib.config.capture import ReleasedConfig
from neuma_lib.config.validation import hint
from neuma_lib.errors import InputError
from neuma_lib.io.files import existing, read_json, reading
from neuma_lib.io.images import OPENGL_TO_OPENCV

RATE = 120.0
"""Frames a second of the videos."""
CALIBRATED_SIZE = (4752, 2672)
"""Pictures that the intrinsics in cameras.bin are of [px]."""
ROOM_FROM_WORLD = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
"""Their axes (z down) to the room's (y up)."""
MIDDLE = (0.15, 0.20)
"""x and y of the middle of the volume that Spring-Gaus' settings leave for the objects."""
GROUND = {"bun": -0.010, "burger": -0.025, "dog": -0.025, "pig": -0.025, "potato": -0.010}
"""z of the floor under each object in Spring-Gaus' settings."""
BESIDE = 3
"""Width of the surroundings of a mask that may still show the object [px]."""
_MODELS = {0: "SIMPLE_PINHOLE", 1: "PINHOLE", 2: "SIMPLE_RADIAL", 3: "RADIAL", 4: "OPENCV"}
_PARAMETERS = {0: 3, 1: 4, 2: 4, 3: 5, 4: 8}
_SUFFIXES = (".jpg", ".jpeg", ".png")


@dataclass(frozen=True, eq=False)
class Shot:
    """A picture with its mask and camera.

    Attributes:
        picture, mask: files.
        lens: of the picture.
        viewmat: world to camera, OpenCV axes, (4, 4), in the files' world.
        number: of the frame; of a photograph, its place in the list.
    """

    picture: Path
    mask: Path
    lens: Lens
    viewmat: np.ndarray
    number: int


@dataclass(frozen=True, eq=False)
class Released:
    """What is in the files of one object.

    Attributes:
        videos: camera -> its frames, in the order of their numbers.
        photographs: of the object at rest, in a world of their own; there may be none.
        contact: number of the first frame of contact; None: not said.
        ground: z of the floor.
    """

    videos: dict[str, list[Shot]]
    photographs: list[Shot] = field(default_factory=list)
    contact: int | None = None
    ground: float = 0.0


def read_released(folder: str | Path, name: str, ground: float | None = None) -> Released:
    """The capture of one object, in either layout.

    Args:
        folder: ``real_capture`` of Spring-Gaus; or NeuMA's folder of the object, or the one above it.
        name: of the object.
        ground: z of the floor; None: as in Spring-Gaus' settings.

    Raises:
        InputError: names the file that is missing or damaged; there is no such object, or no floor is known for it.
    """
    folder = Path(folder)
    if ground is None and name not in GROUND:
        raise InputError(
            f"{name}: no floor is known for this object: state `ground`, z of the floor in the files' world"
        )
    ground = GROUND[name] if ground is None else ground
    if (folder / "dynamic/sequences").is_dir():
        return _spring_gaus(folder, name, ground)
    for own in (folder / name, folder):
        if (own / "dynamics").is_dir():
            return _neuma(own, ground)
    raise InputError(
        f"{folder} is in neither layout: Spring-Gaus' has dynamic/sequences/, NeuMA's {name}/dynamics/; name the folder"
        " that holds these"
    )


THROW = "first"
"""Name of the one throw."""
CONTACT = 5
"""Frames that NeuMA's settings take for free flight."""


def read_configured(name: str, settings: ReleasedConfig) -> Released:
    """The capture that settings name, with photographs from elsewhere where they say so, and a frame of contact.

    Raises:
        InputError: as of `read_released`; there are no photographs.
    """
    known_as = settings.object or name
    found = read_released(settings.folder, known_as, settings.ground)
    photographs = found.photographs
    if settings.photographs:
        photographs = read_released(settings.photographs, known_as, settings.ground).photographs
    if not photographs:
        raise InputError(
            f"captures.released.{name}: {settings.folder} has no photographs of the object at rest: name Spring-Gaus' "
            "folder real_capture, which has them, as `photographs`"
        )
    contact = settings.contact or found.contact or CONTACT
    return replace(found, photographs=photographs, contact=contact)


def released_captures(released: Mapping[str, ReleasedConfig]) -> dict[str, Capture]:
    """Captures that settings name, as those of own folders are (`neuma_lib.capture.folder.read_capture`)."""
    found = {}
    for name, settings in released.items():
        shots = read_released(settings.folder, settings.object or name, settings.ground).videos
        videos = {camera: frames[0].picture for camera, frames in sorted(shots.items())}
        found[name] = Capture(Path(name), settings.as_capture(), (), {}, {THROW: videos})
    return found


def _spring_gaus(folder: Path, name: str, ground: float) -> Released:
    sequences = folder / "dynamic/sequences"
    if not (sequences / name).is_dir():
        raise InputError(
            f"{sequences} has no object '{name}'{hint(name, [p.name for p in sequences.iterdir()])}"
        )
    listed = sequences / name / "0.json"
    frames = read_json(existing(listed, "unpack the archive again"))
    colmap = folder / "static/colmap" / name
    lens = read_cameras(colmap / "cameras.bin")
    poses = _poses(folder / "dynamic/cameras_calib.json")
    videos = {}
    for camera, files in frames.items():
        if camera == "hit_frame":
            continue
        if not isinstance(files, list) or not all(isinstance(file, str) for file in files):
            raise InputError(f"{listed}: {camera}: expected the names of its pictures")
        if camera not in poses:
            raise InputError(f"{listed}: '{camera}' has no pose in cameras_calib.json{hint(camera, poses)}")
        pictures = [_found(folder / "dynamic/videos_images" / camera, file) for file in files]
        masks = [_found(folder / "dynamic/videos_masks" / camera, Path(file).stem) for file in files]
        videos[camera] = _video(pictures, masks, range(len(files)), next(iter(lens.values())), poses[camera])
    contact = frames.get("hit_frame")
    if contact is not None and (type(contact) is not int or contact < 0):
        raise InputError(f"{listed}: hit_frame must be the number of a frame")
    return Released(videos, _photographs(folder, name, lens), contact, ground)


def _neuma(folder: Path, ground: float) -> Released:
    lens = next(iter(read_cameras(folder / "sparse/0/cameras.bin").values()))
    poses = _poses(folder / "cameras_calib.json")
    videos = {}
    for camera in sorted(poses):
        named = re.compile(rf"{re.escape(camera)}_(\d+)")
        files = {}
        for file in sorted((folder / "dynamics").iterdir()):
            match = named.fullmatch(file.stem)
            if match and file.suffix.lower() in _SUFFIXES:
                files[int(match[1])] = file
        if not files:
            raise InputError(f"{folder / 'dynamics'} has no picture {camera}_<step>.jpg")
        numbers = sorted(files)
        pictures = [files[k] for k in numbers]
        masks = [_found(folder / "dynamic_masks", file.stem) for file in pictures]
        videos[camera] = _video(pictures, masks, numbers, lens, poses[camera])
    return Released(videos, ground=ground)


def _video(
    pictures: Sequence[Path], masks: Sequence[Path], numbers, lens: Lens, viewmat: np.ndarray
) -> list[Shot]:
    if not pictures:
        raise InputError("a camera of the capture has no pictures: unpack the archive again")
    size = picture_size(pictures[0])
    pinhole = video_lens(lens, size)
    return [Shot(p, m, pinhole, viewmat, int(k)) for p, m, k in zip(pictures, masks, numbers, strict=True)]


def video_lens(lens: Lens, size: tuple[int, int]) -> Lens:
    """The lens of a video of another size [px]: the photographs' focal lengths scaled, its middle, no distortion."""
    width, height = size
    fx, fy = lens.K[0, 0] * width / CALIBRATED_SIZE[0], lens.K[1, 1] * height / CALIBRATED_SIZE[1]
    return Lens(width, height, np.array([[fx, 0, width / 2], [0, fy, height / 2], [0, 0, 1]]), np.zeros(5))


def _photographs(folder: Path, name: str, lenses: dict[int, Lens]) -> list[Shot]:
    path = folder / "static/colmap" / name / "images.bin"
    shots = []
    for k, (file, camera, viewmat) in enumerate(sorted(read_images(path), key=lambda image: image[0])):
        if camera not in lenses:
            raise InputError(f"{path}: {file} is of camera {camera}, which cameras.bin does not have")
        picture = _found(folder / "static/images" / name, Path(file).stem)
        mask = _found(folder / "static/masks" / name, Path(file).stem)
        width, height = picture_size(mask)
        lens, K = lenses[camera], lenses[camera].K.copy()
        K[0] *= width / lens.width
        K[1] *= height / lens.height
        shots.append(Shot(picture, mask, Lens(width, height, K, lens.distortion), viewmat, k))
    return shots


def _found(folder: Path, name: str) -> Path:
    """A picture of a name, with or without its ending."""
    stem = Path(name).stem if Path(name).suffix.lower() in _SUFFIXES else name
    candidates = [folder / f"{stem}{suffix}" for s in _SUFFIXES for suffix in (s, s.upper())]
    for file in candidates:
        if file.is_file():
            if folder.resolve() not in file.resolve().parents:
                raise InputError(f"{file} leads out of its folder: copy the file there")
            return file
    raise InputError(
        f"{folder / stem}: there is no such picture ({', '.join(_SUFFIXES)}): unpack the archive again"
    )


def _poses(path: Path) -> dict[str, np.ndarray]:
    """World to camera (4, 4) of each camera."""
    found = {}
    for camera, entry in read_json(existing(path, "unpack the archive again")).items():
        if not isinstance(entry, dict) or not {"rvecs", "tvecs"} <= entry.keys():
            raise InputError(f"{path}: {camera}: expected rvecs and tvecs")
        try:
            turn, shift = (np.asarray(entry[key], np.float64).ravel() for key in ("rvecs", "tvecs"))
        except (TypeError, ValueError):
            turn = shift = np.empty(0)
        if turn.shape != (3,) or shift.shape != (3,) or not np.isfinite([*turn, *shift]).all():
            raise InputError(f"{path}: {camera}: rvecs and tvecs must be three numbers each")
        found[camera] = np.eye(4)
        found[camera][:3, :3] = Rotation.from_rotvec(turn).as_matrix()
        found[camera][:3, 3] = shift
    return found


def read_cameras(path: Path) -> dict[int, Lens]:
    """Lenses in COLMAP's cameras.bin, by their numbers; pycolmap reads whole reconstructions alone.

    Raises:
        InputError: missing, damaged, or of another model than `COLMAP_MODELS`.
    """
    content = existing(path, "unpack the archive again").read_bytes()
    found = {}
    with reading(path, "COLMAP's cameras"):
        (count,), at = struct.unpack_from("<Q", content), 8
        for _ in range(count):
            number, model, width, height = struct.unpack_from("<IiQQ", content, at)
            if model not in _MODELS:
                raise ValueError(f"camera model number {model}")
            values = struct.unpack_from(f"<{_PARAMETERS[model]}d", content, at + 24)
            at += 24 + 8 * _PARAMETERS[model]
            found[number] = lens_of_colmap(_MODELS[model], np.array(values), width, height)
    if not found:
        raise InputError(f"{path} has no camera")
    return found


def read_images(path: Path) -> list[tuple[str, int, np.ndarray]]:
    """Name, number of the camera, and world to camera (4, 4) of each picture in COLMAP's images.bin.

    Raises:
        InputError: missing or damaged.
    """
    content = existing(path, "unpack the archive again").read_bytes()
    found = []
    with reading(path, "COLMAP's images"):
        (count,), at = struct.unpack_from("<Q", content), 8
        for _ in range(count):
            _, w, x, y, z, *shift, camera = struct.unpack_from("<I7dI", content, at)
            end = content.index(b"\0", at + 64)
            name = content[at + 64 : end].decode()
            (points,) = struct.unpack_from("<Q", content, end + 1)
            at = end + 9 + 24 * points
            viewmat = np.eye(4)
            viewmat[:3, :3] = Rotation.from_quat((x, y, z, w)).as_matrix()
            viewmat[:3, 3] = shift
            found.append((name, camera, viewmat))
        if at > len(content):
            raise ValueError("it ends too early")
    return found


def room_cameras(viewmats: np.ndarray, ground: float, scale: float) -> np.ndarray:
    """World to camera (N, 4, 4) in the room, y up, the floor at y = 0, the middle of their volume above its origin.

    Args:
        viewmats: in the files' world, (N, 4, 4).
        ground: z of the floor there.
        scale: metres to their unit.
    """
    origin = np.array([*MIDDLE, ground])
    moved = viewmats.copy()
    moved[:, :3, :3] = viewmats[:, :3, :3] @ ROOM_FROM_WORLD.T
    moved[:, :3, 3] = scale * (viewmats[:, :3, 3] + viewmats[:, :3, :3] @ origin)
    return moved


def seen_size(masks: Sequence[np.ndarray], viewmats: np.ndarray, Ks: np.ndarray) -> tuple[np.ndarray, float]:
    """Middle (3,) of what masks of several cameras show, and its usual radius, in the cameras' unit.

    Args:
        masks: Boolean, (H, W), of any sizes, none empty.
        viewmats: world to camera, OpenCV axes, (N, 4, 4).
        Ks: [px], (N, 3, 3).
    """
    middle = nearest_point(np.stack([centroid(mask) for mask in masks]), viewmats, Ks)
    depths = viewmats[:, 2, :3] @ middle + viewmats[:, 2, 3]
    radii = np.sqrt([mask.sum() / np.pi for mask in masks]) * depths / Ks[:, 0, 0]
    if not (radii > 0).all():
        raise InputError("the cameras do not look at one thing: poses and masks are of different captures")
    return middle, float(np.median(radii))


def photographs_about_to_size(
    shots: Sequence[Shot], masks: Sequence[np.ndarray], longest: int, radius: float, height: float
) -> tuple[list[dict[str, Any]], dict[str, Any]]:
    """Entries of a transforms.json for photographs whose world has a scale and directions of its own.

    The object comes to the middle of the simulator's box and about to the size at which it was filmed; registration
    finds the rest.

    Args:
        masks: at the size of ``longest``.
        longest: longer side of the pictures [px].
        radius: of the object as filmed, see `seen_size` [m].
        height: at which it is put [m].

    Returns:
        The entries, and what the file says of its world.
    """
    lenses = [shot.lens.pinhole().resized(longest) for shot in shots]
    viewmats = np.stack([shot.viewmat for shot in shots])
    middle, own = seen_size(masks, viewmats, np.stack([lens.K for lens in lenses]))
    scale = radius / own
    placed = Similarity(scale, np.eye(3), np.array([BOX_MIDDLE[0], height, BOX_MIDDLE[2]]) - scale * middle)
    frames = [
        {
            "file_path": f"{shot.picture.stem}.png",
            "transform_matrix": (np.linalg.inv(viewmat) @ OPENGL_TO_OPENCV).tolist(),
            **lens.intrinsics(),
            "group": PHOTOGRAPHS,
            "view": k,
            "step": 0,
        }
        for k, (shot, lens, viewmat) in enumerate(
            zip(shots, lenses, placed.move_cameras(viewmats), strict=True)
        )
    ]
    return frames, {"scale_known": False, "photographs": {"floor": None}, "placed": placed.plain()}


def video_frames(
    shots: Sequence[Shot], ground: float, scale: float, longest: int, enlarge: float = 1.0
) -> tuple[list[dict[str, Any]], dict[str, Any]]:
    """Entries of a transforms.json for the frames of one camera, in the box, with their times from 0 on [s].

    Args:
        ground, scale: of `room_cameras`.
        longest: longer side of the pictures [px].
        enlarge: metres of the simulator to a metre.

    Returns:
        The entries, and what the file says of its world.
    """
    viewmat = room_cameras(shots[0].viewmat[None], ground, scale)
    in_box = Similarity(enlarge, np.eye(3), np.array(BOX_MIDDLE)).move_cameras(viewmat)[0]
    pose = (np.linalg.inv(in_box) @ OPENGL_TO_OPENCV).tolist()
    lens = shots[0].lens.resized(longest)
    frames = [
        {
            "file_path": f"{shot.number:05d}.png",
            "transform_matrix": pose,
            **lens.intrinsics(),
            "view": 0,
            "step": shot.number,
            "time": shot.number / RATE,
        }
        for shot in shots
    ]
    return frames, {"world": {"scale": enlarge, "offset": list(BOX_MIDDLE)}}


def read_shots(shots: Sequence[Shot], longest: int) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Picture (H, W, 3), uint8, and mask (H, W) of each, undistorted and reduced; a photograph is brought to the size
    of its mask before, as the authors' code does.

    Raises:
        InputError: a file that is no picture, an empty mask, a picture of another shape than its mask.
    """
    for shot in shots:
        width, height = shot.lens.width, shot.lens.height
        pixels = read_picture(shot.picture)
        if pixels.shape[:2] != (height, width):
            if abs(pixels.shape[1] * height - pixels.shape[0] * width) > 2 * max(width, height):
                raise InputError(
                    f"{shot.picture} is {pixels.shape[1]}x{pixels.shape[0]}, its mask {width}x{height}: they are not "
                    "of one picture"
                )
            pixels = np.asarray(Image.fromarray(pixels).resize((width, height), Image.Resampling.BOX))
        yield undistorted(pixels, shot.lens, longest), own_mask(shot.mask, shot.lens, longest)


def plate_behind(pictures: Sequence[np.ndarray], masks: Sequence[np.ndarray]) -> np.ndarray:
    """The empty scene (H, W, 3), uint8: the median of what masks do not cover; where all do, of everything.

    Args:
        pictures: (H, W, 3), uint8, each.
        masks: (H, W), bool, each; their surroundings, `BESIDE` pixels wide, are not taken for empty.
    """
    covered = np.stack([binary_dilation(mask, iterations=BESIDE) for mask in masks])
    covered[:, covered.all(axis=0)] = False
    seen = np.ma.masked_array(np.stack(pictures), np.repeat(covered[..., None], 3, axis=-1))
    return np.ma.median(seen, axis=0).filled(0).round().astype(np.uint8)
