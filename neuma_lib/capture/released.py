"""Reader of the real captures of Spring-Gaus and of their copy by NeuMA's authors.

Both show a dropped object in front of three fixed cameras at 120 frames per second, with a mask for each frame. A
checkerboard defines the world: z points down, the floor is a plane of constant z.

- Spring-Gaus (github.com/Colmar-zlicheng/Spring-Gaus), ``real_capture/``: ``dynamic/cameras_calib.json`` has the pose
  of each camera (OpenCV's rvecs and tvecs), ``dynamic/sequences/<object>/0.json`` the names of its frames and the frame
  of the first contact, ``dynamic/videos_images/<camera>`` and ``videos_masks/<camera>`` the pictures. ``static/`` has
  photographs with masks and COLMAP's cameras, in another world.
- NeuMA (github.com/XJay18/NeuMA), a folder for each object: ``sparse/0/cameras.bin``, ``cameras_calib.json`` with the
  keys r_0, r_1, ..., and ``dynamics/r_<view>_<step>.jpg``, ``dynamic_masks/r_<view>_<step>.png``. No photographs.

Neither contains the intrinsics of the videos. Like the code of both papers, this module scales those of the
photographs' camera (4752 x 2672 pixels) to the video, with a centred principal point and without distortion.

The world is not metric. NeuMA's settings compensate with a frame interval of 10 ms instead of 8.33 ms, which scales
gravity by 1.44 relative to metres.
"""

import re
import struct
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image
from scipy.ndimage import binary_dilation
from scipy.spatial.transform import Rotation

from neuma_lib.capture.calibration.lens import Lens, lens_of_colmap
from neuma_lib.capture.calibration.placement import Similarity
from neuma_lib.capture.calibration.room import BOX_MIDDLE
from neuma_lib.capture.masks.agreement import middle_and_radii
from neuma_lib.capture.masks.mattes import own_mask
from neuma_lib.capture.pictures import picture_size, read_picture, undistorted
from neuma_lib.config.capture import ReleasedConfig
from neuma_lib.config.validation import hint
from neuma_lib.errors import InputError
from neuma_lib.io.files import existing, read_json, reading
from neuma_lib.io.images import OPENGL_TO_OPENCV
from neuma_lib.project.capture_folder import PHOTOGRAPHS
from neuma_lib.project.released_captures import UNPACK, floor_height, object_folder, sequence

RATE = 120.0  # frames per second of the videos
CALIBRATED_SIZE = (4752, 2672)  # picture size of the intrinsics in cameras.bin [px]
ROOM_FROM_WORLD = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
"""From the axes of the files (z down) to the room's (y up)."""
MIDDLE = (0.15, 0.20)  # x and y of the middle of the volume for objects in Spring-Gaus' settings
_MASK_MARGIN = 3  # width of the border around a mask that may still show the object [px]
_MODELS = {0: "SIMPLE_PINHOLE", 1: "PINHOLE", 2: "SIMPLE_RADIAL", 3: "RADIAL", 4: "OPENCV"}
_PARAMETERS = {0: 3, 1: 4, 2: 4, 3: 5, 4: 8}
_SUFFIXES = (".jpg", ".jpeg", ".png")


@dataclass(frozen=True, eq=False)
class Shot:
    """A picture with its mask and camera."""

    # picture, mask: files
    picture: Path
    mask: Path
    lens: Lens  # of the picture
    viewmat: np.ndarray  # world to camera, OpenCV axes, (4, 4), in the world of the files
    number: int  # of the frame, or index of the photograph


@dataclass(frozen=True, eq=False)
class Released:
    """The files of one object."""

    videos: dict[str, list[Shot]]  # camera -> its frames, ordered by number
    # of the object at rest, in another world, possibly none
    photographs: list[Shot] = field(default_factory=list)
    contact: int | None = None  # number of the first frame of contact. None if not given.
    ground: float = 0.0  # z of the floor


def read_released(folder: str | Path, name: str, ground: float | None = None) -> Released:
    """The capture of one object, in either layout.

    Args:
        folder: ``real_capture`` of Spring-Gaus, or NeuMA's folder of the object, or its parent folder.
        name: of the object.
        ground: z of the floor. None: as in Spring-Gaus' settings.

    Raises:
        InputError: a file is missing or damaged, there is no such object, or its floor is unknown.
    """
    ground = floor_height(name, ground)
    folder, is_spring_gaus = object_folder(folder, name)
    return _spring_gaus(folder, name, ground) if is_spring_gaus else _neuma(folder, ground)


CONTACT = 5  # number of frames of free flight in NeuMA's settings


def read_configured(name: str, settings: ReleasedConfig) -> Released:
    """The capture of a section of the settings, with photographs and a contact frame, or InputError."""
    object_name = settings.object or name
    capture = read_released(settings.folder, object_name, settings.ground)
    photographs = capture.photographs
    if settings.photographs:
        photographs = read_released(settings.photographs, object_name, settings.ground).photographs
    if not photographs:
        raise InputError(
            f"captures.released.{name}",
            f"{settings.folder} has no photographs of the object at rest",
            "Set `photographs` to the folder real_capture of Spring-Gaus, which contains them",
        )
    contact = settings.contact or capture.contact or CONTACT
    return replace(capture, photographs=photographs, contact=contact)


def _spring_gaus(folder: Path, name: str, ground: float) -> Released:
    frames, contact = sequence(folder, name)
    lens = read_cameras(folder / "static/colmap" / name / "cameras.bin")
    poses = _poses(folder / "dynamic/cameras_calib.json")
    videos = {}
    for camera, files in frames.items():
        if camera not in poses:
            problem = f"no pose in cameras_calib.json{hint(camera, poses)}"
            raise InputError(f"{folder / 'dynamic/sequences' / name / '0.json'}: {camera}", problem)
        pictures = [_picture(folder / "dynamic/videos_images" / camera, file) for file in files]
        masks = [_picture(folder / "dynamic/videos_masks" / camera, Path(file).stem) for file in files]
        videos[camera] = _video(pictures, masks, range(len(files)), next(iter(lens.values())), poses[camera])
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
            raise InputError(folder / "dynamics", f"no picture {camera}_<step>.jpg", UNPACK)
        numbers = sorted(files)
        pictures = [files[k] for k in numbers]
        masks = [_picture(folder / "dynamic_masks", file.stem) for file in pictures]
        videos[camera] = _video(pictures, masks, numbers, lens, poses[camera])
    return Released(videos, ground=ground)


def _video(
    pictures: Sequence[Path], masks: Sequence[Path], numbers, lens: Lens, viewmat: np.ndarray
) -> list[Shot]:
    pinhole = video_lens(lens, picture_size(pictures[0]))
    return [Shot(p, m, pinhole, viewmat, int(k)) for p, m, k in zip(pictures, masks, numbers, strict=True)]


def video_lens(lens: Lens, size: tuple[int, int]) -> Lens:
    """The lens of a video: focal lengths scaled to its size [px], centred principal point, no distortion."""
    width, height = size
    fx, fy = lens.K[0, 0] * width / CALIBRATED_SIZE[0], lens.K[1, 1] * height / CALIBRATED_SIZE[1]
    return Lens(width, height, np.array([[fx, 0, width / 2], [0, fy, height / 2], [0, 0, 1]]), np.zeros(5))


def _photographs(folder: Path, name: str, lenses: dict[int, Lens]) -> list[Shot]:
    path = folder / "static/colmap" / name / "images.bin"
    shots = []
    for k, (file, camera, viewmat) in enumerate(sorted(read_images(path), key=lambda image: image[0])):
        if camera not in lenses:
            raise InputError(f"{path}: {file}", f"its camera {camera} is not in cameras.bin", UNPACK)
        picture = _picture(folder / "static/images" / name, Path(file).stem)
        mask = _picture(folder / "static/masks" / name, Path(file).stem)
        width, height = picture_size(mask)
        lens, K = lenses[camera], lenses[camera].K.copy()
        K[0] *= width / lens.width
        K[1] *= height / lens.height
        shots.append(Shot(picture, mask, Lens(width, height, K, lens.distortion), viewmat, k))
    return shots


def _picture(folder: Path, name: str) -> Path:
    """Path of a picture, whose name may lack the suffix."""
    stem = Path(name).stem if Path(name).suffix.lower() in _SUFFIXES else name
    candidates = [folder / f"{stem}{suffix}" for s in _SUFFIXES for suffix in (s, s.upper())]
    for file in candidates:
        if file.is_file():
            if folder.resolve() not in file.resolve().parents:
                raise InputError(file, f"it is a link to a file outside {folder}", "Copy the file there")
            return file
    raise InputError(folder / stem, f"no such picture ({', '.join(_SUFFIXES)})", UNPACK)


def _poses(path: Path) -> dict[str, np.ndarray]:
    """World to camera (4, 4) of each camera."""
    poses = {}
    for camera, entry in read_json(existing(path, UNPACK)).items():
        if not isinstance(entry, dict) or not {"rvecs", "tvecs"} <= entry.keys():
            raise InputError(f"{path}: {camera}", "expected rvecs and tvecs")
        try:
            turn, shift = (np.asarray(entry[key], np.float64).ravel() for key in ("rvecs", "tvecs"))
        except (TypeError, ValueError):
            turn = shift = np.empty(0)
        if turn.shape != (3,) or shift.shape != (3,) or not np.isfinite([*turn, *shift]).all():
            raise InputError(f"{path}: {camera}", "rvecs and tvecs must be three numbers each")
        poses[camera] = np.eye(4)
        poses[camera][:3, :3] = Rotation.from_rotvec(turn).as_matrix()
        poses[camera][:3, 3] = shift
    return poses


def read_cameras(path: Path) -> dict[int, Lens]:
    """Lenses in COLMAP's cameras.bin by their numbers. pycolmap only reads complete reconstructions.

    Raises:
        InputError: missing, damaged, or of another model than `COLMAP_MODELS`.
    """
    content = existing(path, UNPACK).read_bytes()
    lenses = {}
    with reading(path, "COLMAP's cameras"):
        (count,), at = struct.unpack_from("<Q", content), 8
        for _ in range(count):
            number, model, width, height = struct.unpack_from("<IiQQ", content, at)
            if model not in _MODELS:
                raise ValueError(f"camera model number {model}")
            values = struct.unpack_from(f"<{_PARAMETERS[model]}d", content, at + 24)
            at += 24 + 8 * _PARAMETERS[model]
            lenses[number] = lens_of_colmap(_MODELS[model], np.array(values), width, height)
    if not lenses:
        raise InputError(path, "it has no camera", UNPACK)
    return lenses


def read_images(path: Path) -> list[tuple[str, int, np.ndarray]]:
    """Name, camera number and world to camera (4, 4) of each picture in COLMAP's images.bin, or InputError."""
    content = existing(path, UNPACK).read_bytes()
    images = []
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
            images.append((name, camera, viewmat))
        if at > len(content):
            raise ValueError("it ends too early")
    return images


def room_cameras(viewmats: np.ndarray, ground: float, scale: float) -> np.ndarray:
    """World to camera (N, 4, 4) in the room: y up, the floor at y = 0, the origin below the middle of the volume.

    Args:
        viewmats: in the world of the files, (N, 4, 4).
        ground: z of the floor there.
        scale: metres per unit of the files.
    """
    origin = np.array([*MIDDLE, ground])
    moved = viewmats.copy()
    moved[:, :3, :3] = viewmats[:, :3, :3] @ ROOM_FROM_WORLD.T
    moved[:, :3, 3] = scale * (viewmats[:, :3, 3] + viewmats[:, :3, :3] @ origin)
    return moved


def seen_size(masks: Sequence[np.ndarray], viewmats: np.ndarray, Ks: np.ndarray) -> tuple[np.ndarray, float]:
    """Centre (3,) and median radius of the object in masks of several cameras, in the cameras' unit.

    Args:
        masks: Boolean, (H, W), of any sizes, none empty.
        viewmats: world to camera, OpenCV axes, (N, 4, 4).
        Ks: [px], (N, 3, 3).
    """
    middle, radii = middle_and_radii(masks, viewmats, Ks)
    if not (radii > 0).all():
        problem = "the object is behind a camera"
        raise InputError("masks", problem, "Check that poses and masks are of the same capture")
    return middle, float(np.median(radii))


def photographs_about_to_size(
    shots: Sequence[Shot], masks: Sequence[np.ndarray], longest: int, radius: float, height: float
) -> tuple[list[dict[str, Any]], dict[str, Any]]:
    """Entries of a transforms.json for photographs in a world of other scale and orientation.

    The object is placed in the middle of the simulation box at approximately the size in the videos. Registration
    estimates the exact pose and scale.

    Args:
        masks: at the size of ``longest``.
        longest: longer side of the pictures [px].
        radius: of the object in the videos, see `seen_size` [m].
        height: of the object's centre [m].

    Returns:
        The entries, and the entries that describe the world of the file.
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
    """Entries of a transforms.json for the frames of one camera, in the simulation box, with times from 0 on [s].

    Args:
        ground, scale: of `room_cameras`.
        longest: longer side of the pictures [px].
        enlarge: simulated metres per metre.

    Returns:
        The entries, and the entries that describe the world of the file.
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
    """Iterate over pictures (H, W, 3), uint8, and masks (H, W), undistorted and reduced.

    Photographs are first resized to the size of their masks, as in the authors' code.

    Raises:
        InputError: a file is no picture, a mask is empty, or a picture has another aspect ratio than its mask.
    """
    for shot in shots:
        width, height = shot.lens.width, shot.lens.height
        pixels = read_picture(shot.picture)
        if pixels.shape[:2] != (height, width):
            if abs(pixels.shape[1] * height - pixels.shape[0] * width) > 2 * max(width, height):
                raise InputError(
                    shot.picture,
                    f"{pixels.shape[1]}x{pixels.shape[0]} pixels, which does not fit the mask of {width}x{height}",
                    UNPACK,
                )
            pixels = np.asarray(Image.fromarray(pixels).resize((width, height), Image.Resampling.BOX))
        yield undistorted(pixels, shot.lens, longest), own_mask(shot.mask, shot.lens, longest)


def background_behind(pictures: Sequence[np.ndarray], masks: Sequence[np.ndarray]) -> np.ndarray:
    """The empty scene (H, W, 3), uint8: median of pixels outside the masks (H, W), dilated by `_MASK_MARGIN`.

    Where all masks overlap, it is the median of all pixels.
    """
    covered = np.stack([binary_dilation(mask, iterations=_MASK_MARGIN) for mask in masks])
    covered[:, covered.all(axis=0)] = False
    seen = np.ma.masked_array(np.stack(pictures), np.repeat(covered[..., None], 3, axis=-1))
    return np.ma.median(seen, axis=0).filled(0).round().astype(np.uint8)
