"""The room: poses in metres, y up, the floor at y = 0, from the board, a known length, or given poses."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from neuma_lib.capture.calibration.board import (
    BoardFit,
    Detection,
    corner_positions,
    fit_board,
    room_from_board,
)
from neuma_lib.capture.calibration.placement import (
    Similarity,
    camera_centres,
    fit_floor,
    scale_from_length,
    upright,
)
from neuma_lib.capture.calibration.poses import Poses, find_boards
from neuma_lib.capture.calibration.vertical import MAX_ANGLE, UP, Cue, camera_cues, check_vertical
from neuma_lib.capture.masks.selection import Box, box_in, locate
from neuma_lib.capture.pictures import (
    group_of,
    orientation_of,
    picture_name,
    read_picture,
    sensor_pixels,
    undistorted,
    write_png,
)
from neuma_lib.config.capture import CaptureConfig, LengthConfig
from neuma_lib.errors import InputError
from neuma_lib.io.images import OPENGL_TO_OPENCV, transform_world, write_transforms
from neuma_lib.project.capture_folder import PHOTOGRAPHS

FLOOR_TOLERANCE = 0.005
"""Distance of near points from the floor, relative to the distance from the cameras to the points."""
# distance from a selected object, in half sizes, and number of points on its floor
_SUPPORT, _MIN_SUPPORT = 4.0, 40
# standard deviation of a marked point [px], and as share of the longer side of the photograph
_MARK = (1.5, 0.001)
BOX_MIDDLE = (0.5, 0.0, 0.5)  # position of the room's origin, on the floor, in the simulation box [m]


@dataclass(frozen=True)
class Scale:
    """Source of the metre of a room, for messages, and its relative standard deviation. None if it is not known."""

    source: str
    deviation: float | None = None


@dataclass(frozen=True, eq=False)
class Room:
    """Poses in metres, y up, the floor at y = 0."""

    poses: Poses  # in the room
    room_from_world: Similarity  # from the world of the estimated poses
    board: BoardFit | None = None  # fit of the board. None without one.
    floor: float | None = None  # share of the points near the fitted floor. None with a board.
    # where the metre comes from. None if the length of the room's unit is unknown.
    scale: Scale | None = None
    cues: tuple[Cue, ...] = ()  # upward directions in the room, the one that defines the room's y first


def find_room(poses: Poses, pictures: Mapping[str, Path], settings: CaptureConfig) -> Room:
    """The room of poses by the method in the settings, from pictures by name.

    Raises:
        InputError: as `room_of`, or its upward direction contradicts the photographs (`check_vertical`).
    """
    held = [i for i, name in enumerate(poses.names) if group_of(name) == PHOTOGRAPHS]
    sizes = [(poses.lenses[i].width, poses.lenses[i].height) for i in held]
    orientations = [orientation_of(pictures[poses.names[i]], size) for i, size in zip(held, sizes)]
    cues = camera_cues(poses.viewmats[held], orientations)
    if settings.poses == "photographs":
        placed = {name: pictures[name] for name in poses.names}
        boards = find_boards(placed, settings.board) if settings.board else {}
        turns = dict(zip((poses.names[i] for i in held), orientations))
        room = room_of(poses, boards, settings, cues, turns)
    else:
        on_board = settings.poses == "board"
        level = room_from_board(settings.board, settings.center) if on_board else Similarity()
        source = Scale("the board" if on_board else f"the poses in {settings.poses}")
        room = Room(poses.moved(level), level, scale=source)
    source = "board" if settings.board else "floor" if room.floor is not None else "given poses"
    turned = (replace(cue, up=room.room_from_world.rotation @ cue.up) for cue in cues)
    room = replace(room, cues=(Cue(source, np.array(UP)), *turned))
    check_vertical(room.cues, PHOTOGRAPHS)
    return room


def room_of(
    poses: Poses,
    detections: Mapping[str, Detection],
    settings: CaptureConfig,
    cues: Sequence[Cue] = (),
    orientations: Mapping[str, int | None] | None = None,
) -> Room:
    """Make poses metric and upright, by the board, else by a known length and a fitted floor.

    The floor is that under the selected object, if there is one. Without board and length, the unit of the room is the
    distance from the cameras to the points.

    Args:
        poses: of structure from motion.
        detections: corners of the board by picture, unused without a board.
        cues: upward directions in the world of the poses. The first one excludes walls from the search of the floor.
        orientations: EXIF orientations of photographs by name, for places in their displayed pictures.

    Raises:
        InputError: see `fit_board`, `scale_from_length`, `fit_floor`.
    """
    if settings.board is not None:
        corners = [detections[name] for name in poses.names]
        fit = fit_board(corners, poses.lenses, poses.viewmats, settings.board)
        room = room_from_board(settings.board, settings.center).after(fit.board_from_world)
        spread = np.linalg.norm(np.ptp(corner_positions(settings.board)[fit.corners], axis=0))
        deviation = fit.residual / (spread * np.sqrt(len(fit.corners)))
        return Room(poses.moved(room), room, board=fit, scale=Scale("the board", float(deviation)))
    centres = camera_centres(poses.viewmats)
    away = (
        np.median(np.linalg.norm(poses.points - centres.mean(axis=0), axis=1)) if len(poses.points) else 0.0
    )
    level = [cues[0].up, MAX_ANGLE + 2 * cues[0].deviation] if cues else []
    middle, boxed = np.median(poses.points, axis=0), _boxed(poses, settings, orientations or {})
    regions = [(poses.points, centres, away)]
    if (located := locate(*boxed)) is not None:
        middle, size = located
        points = poses.points[np.linalg.norm(poses.points - middle, axis=1) < _SUPPORT * size]
        if len(points) >= _MIN_SUPPORT:
            away = np.median(np.linalg.norm(centres - middle, axis=1))
            regions.insert(0, (points, np.concatenate([centres, middle[None]]), away))
    for k, (points, above, away) in enumerate(regions, 1):
        try:
            point, normal, share = fit_floor(points, above, FLOOR_TOLERANCE * away, settings.seed, *level)
        except InputError:  # the points in the box may be those of the floor behind the object
            if k == len(regions):
                raise
        else:
            break
    if (located := locate(*boxed, (point, normal))) is not None:
        middle = located[0]
    level = upright(normal, middle - ((middle - point) @ normal) * normal)
    if settings.length is None:
        scale, source = 1 / max(away, 1e-12), None
    else:
        scale, source = _metres_per_unit(poses.moved(level), settings.length, orientations or {})
    room = Similarity(scale).after(level)
    return Room(poses.moved(room), room, floor=share, scale=source)


def _boxed(
    poses: Poses, settings: CaptureConfig, orientations: Mapping[str, int | None]
) -> tuple[np.ndarray, np.ndarray, dict[int, Box], np.ndarray, np.ndarray]:
    """Arguments of `locate`: cameras, boxes of the object in photographs with poses, and points."""
    boxes, Ks = {}, np.stack([lens.pinhole().K for lens in poses.lenses])
    for file, rectangle in settings.object.items():
        name = picture_name(PHOTOGRAPHS, file)
        if name in poses.names:
            i = poses.names.index(name)
            boxes[i] = box_in(rectangle, orientations.get(name), poses.lenses[i], Ks[i])
    return poses.viewmats, Ks, boxes, poses.points, poses.seen(poses.names)


def _metres_per_unit(
    poses: Poses, length: LengthConfig, orientations: Mapping[str, int | None]
) -> tuple[float, Scale]:
    """Metres per unit of poses whose floor is y = 0, and where they come from.

    Raises:
        InputError: the named photographs have no poses, or the marks do not determine the length.
    """
    stated = length.deviation / length.metres
    if length.cameras is not None:
        names = [picture_name(PHOTOGRAPHS, file) for file in length.cameras]
        if lost := [name for name in names if name not in poses.names]:
            problem = f"{lost[0]} has no pose"
            raise InputError("length.cameras", problem, "Remove `length`, and the flight measures it again")
        a, b = camera_centres(poses.viewmats[[poses.names.index(name) for name in names]])
        distance = float(np.linalg.norm(a - b))
        if not distance > 0:
            raise InputError("length.cameras", "both cameras are at one place", "Name two other photographs")
        return length.metres / distance, Scale("gravity in the video", stated)
    views, marks, lenses = [], [], []
    for file, ends in length.ends.items():
        name = picture_name(PHOTOGRAPHS, file)
        if name in poses.names:
            i = poses.names.index(name)
            lens = poses.lenses[i]
            views.append(poses.viewmats[i])
            marks.append(sensor_pixels(np.array(ends), orientations.get(name), (lens.width, lens.height)))
            lenses.append(lens)
    required = min(2, len(length.ends))
    if len(views) < required:
        problem = f"{len(views)} of the marked photographs were registered, at least {required} must be"
        raise InputError("length.ends", problem, "Mark the points in other photographs")

    def metres_per_unit(shift: np.ndarray) -> float:
        seen = [lens.directions(mark + by) for lens, mark, by in zip(lenses, marks, shift)]
        return scale_from_length(views, seen, length.metres)

    still = np.zeros((len(views), 2, 2))
    scale, variance = metres_per_unit(still), stated**2
    for place in np.ndindex(still.shape):
        shift = still.copy()
        shift[place] = max(_MARK[0], _MARK[1] * max(lenses[0].width, lenses[0].height))
        variance += (metres_per_unit(shift) / scale - 1) ** 2
    source = "a length on the floor" if len(views) == 1 else f"a length in {len(views)} photographs"
    return scale, Scale(source, float(np.sqrt(variance)))


def write_room(
    path: str | Path, room: Room, pictures: Mapping[str, Path], settings: CaptureConfig
) -> dict[str, Any]:
    """Write undistorted pictures and the transforms.json at ``path``, with the room in the simulation box.

    ``world`` of the file is the transform from the room to the box, ``room`` that from the reconstruction to the room.
    Returns the `report`.
    """
    folder = Path(path).parent
    folder.mkdir(parents=True, exist_ok=True)
    Path(path).unlink(missing_ok=True)  # a folder without it is incomplete
    frames = []
    views = {
        group: i for i, group in enumerate(sorted({group_of(n) for n in room.poses.names} - {PHOTOGRAPHS}))
    }
    photographs = 0
    for name, lens, viewmat in zip(room.poses.names, room.poses.lenses, room.poses.viewmats):
        smaller = lens.pinhole().resized(settings.longest)
        pixels = undistorted(read_picture(pictures[name], (lens.width, lens.height)), lens, settings.longest)
        file = folder / Path(name).with_suffix(".png")
        write_png(file, pixels)
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
    world = transform_world(frames, settings.scale, offset)
    write_transforms(path, {}, frames, room=room.room_from_world.plain(), **world)
    return report(room)


def report(room: Room) -> dict[str, Any]:
    """JSON report of the poses."""
    poses = room.poses
    lenses = {group_of(name): lens.plain() for name, lens in zip(poses.names, poses.lenses)}
    return {
        "registered": len(poses.names),
        "pictures": len(poses.names) + len(poses.lost),
        "lost": list(poses.lost),
        "points": len(poses.points),
        "reprojection_error_px": poses.error if np.isfinite(poses.error) else None,
        "lenses": lenses,
        "unsure": {name: list(values) for name, values in poses.unsure.items()},
        "board": room.board.plain() if room.board else None,
        "share_of_points_on_floor": room.floor,
        "scale": {"source": room.scale.source, "deviation": room.scale.deviation} if room.scale else None,
        "up": [cue.plain() for cue in room.cues],
        "centres_m": dict(zip(poses.names, camera_centres(poses.viewmats).tolist())),
    }
