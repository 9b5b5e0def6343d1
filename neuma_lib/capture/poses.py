"""Where the cameras stood: from the photographs together (structure from motion), from the board alone, or as given.

Pictures come in groups that share a lens: `photographs`, and each fixed camera with its picture of the empty scene. A
picture's name is ``<group>/<file>``.

Pictures are taken as the sensor wrote them: a note to turn them is removed, since the tools disagree about it, and a
phone's lens is the same however it is held.
"""

from __future__ import annotations

import shutil
import struct
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from PIL import Image

from neuma_lib.capture.board import BoardFit, Detection, board_pose, find_board, fit_board, room_from_board
from neuma_lib.capture.folder import PHOTOGRAPHS, Capture, inside
from neuma_lib.capture.lens import Lens, lens_of_colmap, read_lens
from neuma_lib.capture.placement import (
    Similarity,
    camera_centres,
    fit_floor,
    identity,
    stated_length,
    upright,
)
from neuma_lib.capture.tools import colmap, opencv
from neuma_lib.config.capture import CaptureConfig, LengthConfig
from neuma_lib.errors import InputError
from neuma_lib.io.files import atomic, one_line, read_json, reading
from neuma_lib.io.images import (
    OPENGL_TO_OPENCV,
    open_image,
    place,
    read_transforms,
    write_transforms,
)

LEAST_PHOTOGRAPHS = 8
"""Fewest photographs that structure from motion is tried with."""
FEW_PHOTOGRAPHS = 20
"""Below this many, it begins with less: see `_mapping_options`."""
LEAST_REGISTERED = 0.7
"""Least share of the photographs that must find their place."""
LARGEST = 2400
"""Longer side at which features are sought [px]."""
PHOTOGRAPH_MODEL, STILL_MODEL = "RADIAL", "SIMPLE_RADIAL"
"""COLMAP's camera models, with square pixels: on ten photographs a second focal length went 4 % astray. One picture of
a fixed camera does not tell more than focal length and one coefficient."""
FLOOR_TOLERANCE = 0.005
"""Distance from the floor that counts as near, as share of the distance from the cameras to the points."""
BOX_MIDDLE = (0.5, 0.0, 0.5)
"""Where the room's origin, on the floor, is put in the simulator's box [m]."""
ORIENTATION = 0x0112
"""EXIF's note of how to turn a picture."""


@dataclass(frozen=True, eq=False)
class Poses:
    """Cameras of pictures, in one world.

    Attributes:
        names: of the pictures, (N,).
        lenses: of each picture, (N,).
        viewmats: world to camera, (N, 4, 4).
        points: of the scene, (P, 3).
        colours: of the points, (P, 3), uint8.
        error: mean distance of the points in the pictures from where they were seen [px].
        lost: names of pictures that found no place.
    """

    names: tuple[str, ...]
    lenses: tuple[Lens, ...]
    viewmats: np.ndarray
    points: np.ndarray
    colours: np.ndarray
    error: float
    lost: tuple[str, ...] = ()

    def moved(self, by: Similarity) -> Poses:
        """The same, with all of the world moved."""
        return replace(self, viewmats=by.move_cameras(self.viewmats), points=by.apply(self.points))


@dataclass(frozen=True, eq=False)
class Room:
    """Poses in metres, y up, the floor at y = 0, and how that was found.

    Attributes:
        poses: in the room.
        room_from_world: from the world in which the poses were found.
        board: fit of the board; None without one.
        floor: share of the points near the fitted floor; None with a board.
    """

    poses: Poses
    room_from_world: Similarity
    board: BoardFit | None = None
    floor: float | None = None


def group_of(name: str) -> str:
    """Group of a picture."""
    return name.split("/")[0]


def gather_pictures(groups: Mapping[str, Sequence[Path]], target: str | Path) -> dict[str, Path]:
    """Copy pictures into a folder for each group, without notes to turn them.

    Returns:
        Name of the picture -> file.

    Raises:
        InputError: a file that is no picture; pictures of different sizes in a group.
    """
    found: dict[str, Path] = {}
    for group, files in groups.items():
        sizes: dict[tuple[int, int], Path] = {}
        for file in files:
            copy = Path(target) / group / file.name
            content = file.read_bytes()
            with open_image(content, file) as image:
                sizes.setdefault(image.size, file)
                turned = image.getexif().get(ORIENTATION, 1) != 1
                with atomic(copy) as partial:
                    if not turned:
                        shutil.copyfile(file, partial)
                    elif image.format == "JPEG":
                        with reading(file, "an image"):
                            upright_content = _unturned(content, image.info["exif"])
                        partial.write_bytes(upright_content)
                    else:
                        with reading(file, "an image"):
                            pixels = image.convert("RGB")
                        pixels.save(partial, image.format, lossless=True)
            found[f"{group}/{file.name}"] = copy
        if len(sizes) > 1:
            (first, a), (second, b) = list(sizes.items())[:2]
            raise InputError(
                f"{a} is {first[0]}x{first[1]}, {b} is {second[0]}x{second[1]}: all pictures of '{group}' must be of "
                "one camera, at one zoom and size, and not cropped or turned by a program"
            )
    return found


def _unturned(content: bytes, exif: bytes) -> bytes:
    """A JPEG file whose first directory of notes (TIFF 6.0, section 2) says that the picture is upright; no pixel of it
    is touched.

    Raises ValueError or struct.error where the notes are damaged.
    """
    if exif not in content:
        raise ValueError("its EXIF notes are in several parts")
    tiff = exif.index(b"Exif\0\0") + 6
    order = "<" if exif[tiff : tiff + 2] == b"II" else ">"
    directory = tiff + struct.unpack_from(f"{order}I", exif, tiff + 4)[0]
    changed = bytearray(exif)
    for entry in range(struct.unpack_from(f"{order}H", exif, directory)[0]):
        at = directory + 2 + 12 * entry
        if struct.unpack_from(f"{order}H", exif, at)[0] == ORIENTATION:
            struct.pack_into(f"{order}H", changed, at + 8, 1)
    return content.replace(exif, bytes(changed), 1)


def read_lenses(path: str | Path) -> dict[str, Lens]:
    """Lenses by group, of a JSON file: {group: {fl_x, fl_y, cx, cy, w, h, k1, ...}}.

    Raises:
        InputError: names the file, the group and the key.
    """
    values = read_json(path)
    if not isinstance(values, dict) or not values:
        raise InputError(f"{path}: expected intrinsics by the name of a camera")
    return {group: read_lens(lens, f"{path}: {one_line(group)}") for group, lens in values.items()}


def structure_from_motion(
    pictures: Mapping[str, Path],
    work: str | Path,
    seed: int = 0,
    threads: int = 1,
    lenses: Mapping[str, Lens] | None = None,
) -> Poses:
    """Cameras and points from pictures that overlap, in a world of any scale and direction.

    SIFT features on the CPU, every picture matched with every other, incremental mapping (COLMAP). The same seed and
    one thread give the same result.

    Args:
        pictures: name -> file, `<folder>/<group>/<file>` as `gather_pictures` lays them out.
        work: folder for COLMAP's files.
        seed: of all random draws.
        threads: processors to use.
        lenses: known lenses by group, which are kept; others are found.

    Raises:
        InputError: too few photographs, too few or no fixed camera that found its place.
    """
    photographs = [name for name in pictures if group_of(name) == PHOTOGRAPHS]
    if len(photographs) < LEAST_PHOTOGRAPHS:
        raise InputError(
            f"{len(photographs)} photographs are too few: {LEAST_PHOTOGRAPHS} are the least, take 30 to 60 all around "
            "the object, each overlapping the last by two thirds"
        )
    pycolmap = colmap()
    pycolmap.logging.minloglevel = int(pycolmap.logging.Level.WARNING.value)
    pycolmap.set_random_seed(seed)
    lenses = lenses or {}
    work, root = Path(work), next(iter(pictures.values())).parent.parent
    work.mkdir(parents=True, exist_ok=True)
    database, models_folder = work / "database.db", work / "models"
    database.unlink(missing_ok=True)  # of an earlier run
    shutil.rmtree(models_folder, ignore_errors=True)
    models_folder.mkdir()
    extraction = pycolmap.FeatureExtractionOptions(max_image_size=LARGEST, num_threads=threads, use_gpu=False)
    for group in dict.fromkeys(map(group_of, pictures)):
        reader = pycolmap.ImageReaderOptions(
            camera_model=PHOTOGRAPH_MODEL if group == PHOTOGRAPHS else STILL_MODEL
        )
        if group in lenses:
            reader.camera_model = "FULL_OPENCV"
            lens = lenses[group]
            # k4 to k6, a denominator, are 0
            values = [*lens.K[[0, 1], [0, 1]], *lens.K[:2, 2], *lens.distortion, 0, 0, 0]
            reader.camera_params = ",".join(repr(float(v)) for v in values)
        pycolmap.extract_features(
            database,
            root,
            image_names=[name for name in pictures if group_of(name) == group],
            camera_mode=pycolmap.CameraMode.PER_FOLDER,
            reader_options=reader,
            extraction_options=extraction,
            device=pycolmap.Device.cpu,
        )
    matching = pycolmap.FeatureMatchingOptions(num_threads=threads, use_gpu=False)
    verification = pycolmap.TwoViewGeometryOptions()
    verification.ransac.random_seed = seed
    pycolmap.match_exhaustive(
        database, matching, verification_options=verification, device=pycolmap.Device.cpu
    )
    options = _mapping_options(len(photographs), seed, threads)
    with pycolmap.Database.open(database) as opened:
        known = {image.camera_id for image in opened.read_all_images() if group_of(image.name) in lenses}
    options.constant_cameras = known
    models = pycolmap.incremental_mapping(database, root, models_folder, options)
    if not models:
        raise InputError(
            "no two photographs could be matched: are they sharp, do they overlap, and has the floor texture? Lay the "
            "printed board and newspapers under the object"
        )
    best = max(models.values(), key=lambda model: (model.num_reg_images(), model.num_points3D()))
    poses = _poses_of(best, pictures, lenses)
    check_registered(poses)
    return poses


def check_registered(poses: Poses) -> None:
    """Enough photographs and every fixed camera have found their places. Raises InputError, which names the others."""
    lost = [name for name in poses.lost if group_of(name) == PHOTOGRAPHS]
    placed = sum(group_of(name) == PHOTOGRAPHS for name in poses.names)
    if placed < LEAST_REGISTERED * (placed + len(lost)):
        raise InputError(
            f"only {placed} of {placed + len(lost)} photographs found their place (not {_some(lost)}): photograph more "
            "densely, all around and at two heights, sharp, with nothing moved between photographs"
        )
    for name in poses.lost:
        if group_of(name) != PHOTOGRAPHS:
            raise InputError(
                f"the fixed camera of {name} found no place among the photographs: take some photographs from where it "
                "stands, with the same light; or lay the board into its view, give its `lens` and set poses: board"
            )


def _some(names: Sequence[str], most: int = 5) -> str:
    more = f" and {len(names) - most} more" if len(names) > most else ""
    return ", ".join(name.split("/")[-1] for name in names[:most]) + more


def _mapping_options(photographs: int, seed: int, threads: int):
    options = colmap().IncrementalPipelineOptions()
    options.random_seed = options.mapper.random_seed = options.triangulation.random_seed = seed
    options.num_threads = threads
    options.min_model_size = 3
    options.extract_colors = True
    if photographs < FEW_PHOTOGRAPHS:
        options.mapper.init_min_num_inliers = 50
        options.mapper.abs_pose_min_num_inliers = 15
        options.mapper.init_min_tri_angle = 8.0
    return options


def _poses_of(model: Any, pictures: Mapping[str, Path], lenses: Mapping[str, Lens]) -> Poses:
    """What this project keeps of COLMAP's reconstruction."""
    images = {model.images[number].name: model.images[number] for number in model.reg_image_ids()}
    names = tuple(name for name in pictures if name in images)
    viewmats = np.tile(np.eye(4), (len(names), 1, 1))
    found = []
    for viewmat, name in zip(viewmats, names):
        viewmat[:3] = images[name].cam_from_world().matrix()
        camera = images[name].camera
        lens = lenses.get(group_of(name))
        found.append(lens or lens_of_colmap(camera.model.name, camera.params, camera.width, camera.height))
    points = [model.points3D[number] for number in sorted(model.points3D)]
    return Poses(
        names,
        tuple(found),
        viewmats,
        np.array([point.xyz for point in points]).reshape(-1, 3),
        np.array([point.color for point in points], np.uint8).reshape(-1, 3),
        float(model.compute_mean_reprojection_error()),
        tuple(name for name in pictures if name not in images),
    )


def poses_from_board(
    found: Mapping[str, Detection], lenses: Mapping[str, Lens], settings: CaptureConfig
) -> Poses:
    """Cameras from the board in each picture, in the board's frame [m]; photographs that do not show it are lost.

    Raises:
        InputError: a group without a lens; a fixed camera that does not see the board; too few photographs that do.
    """
    names, poses, errors, lost = [], [], [], []
    for name, corners in found.items():
        if group_of(name) not in lenses:
            raise InputError(
                f"{settings.lens}: no lens for '{group_of(name)}', which poses: board needs; known: "
                f"{', '.join(lenses)}"
            )
        try:
            pose, error = board_pose(corners, settings.board, lenses[group_of(name)], name)
        except InputError:
            if group_of(name) != PHOTOGRAPHS:
                raise
            lost.append(name)
            continue
        names.append(name)
        poses.append(pose)
        errors.append(error)
    if not names:
        raise InputError(
            f"none of {len(found)} pictures shows the board: lay it beside the object, uncovered"
        )
    placed = Poses(
        tuple(names),
        tuple(lenses[group_of(name)] for name in names),
        np.stack(poses),
        np.empty((0, 3)),
        np.empty((0, 3), np.uint8),
        float(np.mean(errors)),
        tuple(lost),
    )
    check_registered(placed)
    return placed


def given_poses(path: str | Path, pictures: Mapping[str, Path]) -> Poses:
    """Cameras of a transforms.json that names the pictures, in metres, y up, the floor at y = 0.

    A picture is found by the end of its ``file_path``: `<group>/<file>`, or the file alone. Distortion is k1, k2, p1,
    p2, k3 of a frame or of the file.

    Raises:
        InputError: names the file and the frame or the picture.
    """
    data = read_transforms(path)
    frames: dict[str, dict[str, Any]] = {}
    for frame in data["frames"]:
        parts = Path(frame["file_path"]).parts
        for key in ("/".join(parts[-2:]), parts[-1]):
            frames.setdefault(key, {**data, **frame})
    names, lenses, viewmats, lost = [], [], [], []
    for name, file in pictures.items():
        frame = frames.get(name) or frames.get(name.split("/")[-1])
        if frame is None:
            lost.append(name)
            continue
        with open_image(file.read_bytes(), file) as image:
            size = {"w": image.width, "h": image.height}
        lens = read_lens({**_centred(frame, **size), **size}, f"{path}: {name}")
        if (frame.get("w", lens.width), frame.get("h", lens.height)) != (lens.width, lens.height):
            raise InputError(
                f"{path}: w, h of {name} are not those of the picture, {lens.width}x{lens.height}"
            )
        names.append(name)
        lenses.append(lens)
        viewmats.append(np.linalg.inv(np.array(frame["transform_matrix"], np.float64) @ OPENGL_TO_OPENCV))
    if lost:
        raise InputError(f"{path} lists no frame for {_some(lost)}: add it, or remove the picture")
    nothing = np.empty((0, 3))
    return Poses(tuple(names), tuple(lenses), np.stack(viewmats), nothing, nothing.astype(np.uint8), np.nan)


def _centred(frame: Mapping[str, Any], w: int, h: int) -> dict[str, Any]:
    """Intrinsics of a frame with what transforms.json may leave out."""
    known = ("fl_x", "fl_y", "cx", "cy", "k1", "k2", "p1", "p2", "k3")
    values = {key: frame[key] for key in known if key in frame}
    focal = values.get("fl_x")
    if focal is None and "camera_angle_x" in frame:
        focal = 0.5 * w / np.tan(0.5 * frame["camera_angle_x"])
    return {"fl_x": focal, "fl_y": focal, "cx": w / 2, "cy": h / 2, **values}


def find_room(capture: Capture, work: str | Path, threads: int = 1) -> tuple[Room, dict[str, Path]]:
    """Cameras of a capture's photographs and stills, in the way that its settings name.

    Args:
        work: folder for copies of the pictures and for COLMAP's files.
        threads: processors to use.

    Returns:
        The room, and name of the picture -> copied file, which `write_room` takes.

    Raises:
        InputError: see the functions that it calls.
    """
    settings = capture.settings
    groups = {PHOTOGRAPHS: list(capture.photographs), **{c: [still] for c, still in capture.stills.items()}}
    pictures = gather_pictures(groups, Path(work) / "pictures")
    lenses = read_lenses(inside(capture.folder, settings.lens)) if settings.lens else {}
    for name, file in pictures.items():
        if (lens := lenses.get(group_of(name))) is not None:
            with open_image(file.read_bytes(), file) as image:
                if image.size != (lens.width, lens.height):
                    raise InputError(
                        f"{capture.folder / settings.lens}: the lens of '{group_of(name)}' is of {lens.width}x"
                        f"{lens.height} pixels, {name} has {image.width}x{image.height}: calibrate at this size"
                    )
    if settings.poses == "photographs":
        poses = structure_from_motion(pictures, Path(work) / "colmap", settings.seed, threads, lenses)
        found = find_boards(pictures, settings) if settings.board else {}
        return room_of(poses, found, settings), pictures
    if settings.poses == "board":
        poses = poses_from_board(find_boards(pictures, settings), lenses, settings)
        room = room_from_board(settings.board, settings.center)
        return Room(poses.moved(room), room), pictures
    return Room(given_poses(inside(capture.folder, settings.poses), pictures), identity()), pictures


def find_boards(pictures: Mapping[str, Path], settings: CaptureConfig) -> dict[str, Detection]:
    """Corners of the board in every picture, by name."""
    return {name: find_board(read_picture(file), settings.board) for name, file in pictures.items()}


def room_of(poses: Poses, found: Mapping[str, Detection], settings: CaptureConfig) -> Room:
    """Make poses metric, upright and placed: by the board, else by the stated length and a fitted floor.

    Args:
        poses: of structure from motion.
        found: corners of the board by picture; not read without a board.

    Raises:
        InputError: see `fit_board`, `stated_length`, `fit_floor`.
    """
    if settings.board is not None:
        corners = [found[name] for name in poses.names]
        fit = fit_board(corners, poses.lenses, poses.viewmats, settings.board)
        room = room_from_board(settings.board, settings.center).after(fit.board_from_world)
        return Room(poses.moved(room), room, board=fit)
    centres = camera_centres(poses.viewmats)
    away = (
        np.median(np.linalg.norm(poses.points - centres.mean(axis=0), axis=1)) if len(poses.points) else 0.0
    )
    point, normal, share = fit_floor(poses.points, centres, FLOOR_TOLERANCE * away, settings.seed)
    middle = np.median(poses.points, axis=0)
    level = upright(normal, middle - ((middle - point) @ normal) * normal)
    scale = _metres_per_unit(poses, settings.length)
    room = Similarity(scale, np.eye(3), np.zeros(3)).after(level)
    return Room(poses.moved(room), room, floor=share)


def _metres_per_unit(poses: Poses, length: LengthConfig) -> float:
    views, directions = [], []
    for file, ends in length.ends.items():
        name = f"{PHOTOGRAPHS}/{file}"
        if name in poses.names:
            i = poses.names.index(name)
            views.append(poses.viewmats[i])
            directions.append(poses.lenses[i].directions(np.array(ends)))
    if len(views) < 2:
        raise InputError(
            "length.ends: fewer than two of the marked photographs found their place: mark the points in others"
        )
    return stated_length(views, directions, length.metres)


def read_picture(file: Path) -> np.ndarray:
    """RGB (H, W, 3), uint8, as the sensor wrote it."""
    with open_image(file.read_bytes(), file) as image, reading(file, "an image"):
        return np.asarray(image.convert("RGB"))


def write_room(
    path: str | Path, room: Room, pictures: Mapping[str, Path], settings: CaptureConfig
) -> dict[str, Any]:
    """Write undistorted pictures and their transforms.json, with the room placed into the simulator's box.

    ``world`` of the file says how the room's metres were placed; ``room`` how the room came from the reconstruction.

    Args:
        path: .../transforms.json.

    Returns:
        The report: pictures, errors, lenses, board or floor.
    """
    folder = Path(path).parent
    folder.mkdir(parents=True, exist_ok=True)
    Path(path).unlink(missing_ok=True)  # a folder without it is an unfinished one
    frames = []
    views = {
        group: i for i, group in enumerate(sorted({group_of(n) for n in room.poses.names} - {PHOTOGRAPHS}))
    }
    photographs = 0
    for name, lens, viewmat in zip(room.poses.names, room.poses.lenses, room.poses.viewmats):
        smaller = lens.pinhole().resized(settings.longest)
        pixels = undistorted(read_picture(pictures[name]), lens, settings.longest)
        file = folder / Path(name).with_suffix(".png")
        with atomic(file) as partial:
            Image.fromarray(pixels).save(partial, "PNG")
        group = group_of(name)
        view = photographs if group == PHOTOGRAPHS else views[group]
        photographs += group == PHOTOGRAPHS
        frames.append(
            {
                "file_path": str(file.relative_to(folder)),
                "transform_matrix": (np.linalg.inv(viewmat) @ OPENGL_TO_OPENCV).tolist(),
                **smaller.intrinsics(),
                "group": group,
                "view": view,
                "step": 0,
            }
        )
    offset = tuple(np.array(BOX_MIDDLE, np.float64).tolist())
    world = place(frames, settings.scale, offset)
    write_transforms(path, {}, frames, room=room.room_from_world.plain(), **world)
    return report(room)


def undistorted(pixels: np.ndarray, lens: Lens, longest: int) -> np.ndarray:
    """A picture (H, W, 3), uint8, as the pinhole of `Lens.pinhole` and `Lens.resized` sees it."""
    smaller = lens.pinhole().resized(longest)
    whole = lens.undistort(pixels)
    if (smaller.width, smaller.height) == (lens.width, lens.height):
        return whole
    cv2 = opencv()
    return cv2.resize(whole, (smaller.width, smaller.height), interpolation=cv2.INTER_AREA)


def report(room: Room) -> dict[str, Any]:
    """What is known of the poses, for people and for later stages."""
    poses = room.poses
    lenses = {group_of(name): lens.plain() for name, lens in zip(poses.names, poses.lenses)}
    return {
        "registered": len(poses.names),
        "pictures": len(poses.names) + len(poses.lost),
        "lost": list(poses.lost),
        "points": len(poses.points),
        "reprojection_error_px": poses.error if np.isfinite(poses.error) else None,
        "lenses": lenses,
        "board": room.board.plain() if room.board else None,
        "share_of_points_on_floor": room.floor,
        "centres_m": dict(zip(poses.names, camera_centres(poses.viewmats).tolist())),
    }


def draw_room(path: str | Path, room: Room) -> None:
    """Write a picture of cameras and points, from above and from the side, in metres."""
    poses = room.poses
    centres = camera_centres(poses.viewmats)
    forward = poses.viewmats[:, 2, :3]
    fixed = np.array([group_of(name) != PHOTOGRAPHS for name in poses.names])
    reach = 1.2 * max(np.abs(centres).max(), 0.1)
    near = (np.abs(poses.points) < reach).all(axis=1)
    figure = Figure(figsize=(12, 6), layout="constrained")
    for axes, (across, up, title) in zip(
        figure.subplots(1, 2), ((0, 2, "from above"), (0, 1, "from the side"))
    ):
        axes.scatter(*poses.points[near][:, [across, up]].T, s=1, c=poses.colours[near] / 255.0, linewidths=0)
        for chosen, colour, label in (
            (~fixed, "tab:blue", "photographs"),
            (fixed, "tab:red", "fixed cameras"),
        ):
            axes.quiver(
                *centres[chosen][:, [across, up]].T,
                *(0.15 * reach * forward[chosen][:, [across, up]]).T,
                angles="xy",
                scale_units="xy",
                scale=1,
                color=colour,
                width=0.004,
                label=label,
            )
        axes.set(title=title, xlabel="x [m]", ylabel=f"{'xyz'[up]} [m]", aspect="equal")
        axes.set(xlim=(-reach, reach), ylim=(-reach, reach) if up == 2 else (-0.15 * reach, reach))
        axes.grid(alpha=0.3)
        if up == 1:
            axes.axhline(0, color="black", linewidth=1)
        else:
            axes.invert_yaxis()  # x right, z towards the reader: seen from +y
            axes.legend()
    title = f"{len(poses.names)} of {len(poses.names) + len(poses.lost)} pictures"
    title += f", {poses.error:.2f} px" if np.isfinite(poses.error) else ""
    title += f", board {1000 * room.board.residual:.2f} mm" if room.board else ""
    figure.suptitle(title)
    with atomic(path) as partial:
        FigureCanvasAgg(figure).print_png(partial, metadata={"Software": None})
