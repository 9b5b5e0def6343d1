"""Camera poses: from structure from motion on the photographs, from the board alone, or from a file."""

import copy
import shutil
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from neuma_lib.capture.calibration.board import Detection, board_pose, find_board
from neuma_lib.capture.calibration.lens import Lens, lens_of_colmap, read_lens
from neuma_lib.capture.calibration.placement import Similarity
from neuma_lib.capture.calibration.resection import MIN_POINTS, Sighting, resect, triangulated
from neuma_lib.capture.pictures import (
    copy_pictures,
    group_of,
    name_pictures,
    picture_size,
    read_picture,
    sensor_sizes,
)
from neuma_lib.capture.tools import colmap
from neuma_lib.config.capture import BoardConfig
from neuma_lib.errors import InputError
from neuma_lib.io.files import one_line, read_json, reading, write_json
from neuma_lib.io.images import OPENGL_TO_OPENCV, read_transforms
from neuma_lib.io.ply import read_ply, write_ply
from neuma_lib.project.capture_folder import PHOTOGRAPHS

_MIN_PHOTOGRAPHS = 8  # photographs required for structure from motion
FEW_PHOTOGRAPHS = 20
"""Number below which thresholds are lower (`_mapping_options`) and the lens is not refined (`_refine_lens`)."""
_MIN_REGISTERED = 0.7  # share of the photographs that must be registered
_MIN_GROUP = 3  # photographs of another scene
_LARGEST = 2400  # longer side of pictures for feature extraction [px]
PHOTOGRAPH_MODEL, STILL_MODEL = "RADIAL", "SIMPLE_RADIAL"
"""COLMAP's camera models during mapping, with square pixels and a centred lens: with ten photographs, a second focal
length is off by up to 4 %."""
REFINED_MODEL = "OPENCV"
"""Final model of the photographs, with a free principal point, if there are enough of them."""
MAX_OFF_CENTRE = 0.02
"""Distance of a phone's principal point from the centre, as share of the longer side. A larger one is undetermined."""
_MAX_STRETCH = 0.01  # relative difference between the focal lengths of the two sides


@dataclass(frozen=True, eq=False)
class Poses:
    """Cameras of pictures, in one world."""

    names: tuple[str, ...]  # of the pictures, (N,)
    lenses: tuple[Lens, ...]  # of each picture, (N,)
    viewmats: np.ndarray  # world to camera, (N, 4, 4)
    points: np.ndarray  # of the scene, (P, 3)
    colours: np.ndarray  # of the points, (P, 3), uint8
    error: float  # mean reprojection error [px]
    lost: tuple[str, ...] = ()  # names of pictures that were not registered
    # for pictures of fixed cameras with an estimated lens, by name: standard deviations of the principal
    # point in x and y [px], and of the direction about its worst axis [degrees]
    unsure: Mapping[str, tuple[float, float, float]] = field(default_factory=dict)
    # numbers of the points that each picture shows, N arrays. Empty if unknown.
    sightings: tuple[np.ndarray, ...] = ()

    def seen(self, names: Sequence[str]) -> np.ndarray:
        """Which points pictures show, Boolean, (len(names), P)."""
        seen = np.zeros((len(names), len(self.points)), bool)
        for row, name in zip(seen, names):
            if self.sightings and name in self.names:
                row[self.sightings[self.names.index(name)]] = True
        return seen

    def moved(self, by: Similarity) -> "Poses":
        """The poses after a similarity of the world."""
        return replace(self, viewmats=by.move_cameras(self.viewmats), points=by.apply(self.points))


def find_poses(
    groups: Mapping[str, Sequence[Path]],
    source: str,
    work: str | Path,
    lenses: str | Path | None = None,
    board: BoardConfig | None = None,
    seed: int = 0,
    threads: int = 1,
) -> Poses:
    """Cameras of photographs and stills.

    Args:
        groups: pictures of `photographs` and of each fixed camera.
        source: `photographs`, `board`, or the path of a transforms.json.
        work: folder for copies of the pictures and for COLMAP's files.
        lenses: file of `read_lenses`.
        board: for the source `board`.
        seed, threads: see `structure_from_motion`.

    Raises:
        InputError: as the functions that it calls, or a lens of another size than its pictures.
    """
    pictures = name_pictures(groups)
    known = read_lenses(lenses) if lenses else {}
    for name, file in pictures.items():
        if (lens := known.get(group_of(name))) is not None:
            size = picture_size(file)
            if sorted(size) != sorted((lens.width, lens.height)):
                raise InputError(
                    f"{lenses}: {group_of(name)}",
                    f"the lens has {lens.width}x{lens.height} pixels, {file} has {size[0]}x{size[1]}",
                    "Calibrate it at the size of the pictures",
                )
    if source == "photographs":
        copies = copy_pictures(pictures, Path(work) / "pictures")
        return structure_from_motion(copies, Path(work) / "colmap", seed, threads, known)
    if source == "board":
        return poses_from_board(find_boards(pictures, board), known, board, lenses)
    return given_poses(source, pictures)


def find_boards(pictures: Mapping[str, Path], board: BoardConfig) -> dict[str, Detection]:
    """Corners of the board in every picture, by name."""
    sizes = sensor_sizes(pictures)
    return {name: find_board(read_picture(file, sizes[name]), board) for name, file in pictures.items()}


def save_poses(path: str | Path, points: str | Path, poses: Poses) -> None:
    """Write cameras as JSON and points as PLY."""
    columns = [(axis, "<f4", poses.points[:, i]) for i, axis in enumerate("xyz")]
    columns += [(channel, "u1", poses.colours[:, i]) for i, channel in enumerate(("red", "green", "blue"))]
    rows = np.empty(len(poses.points), dtype=[(name, kind) for name, kind, _ in columns])
    for name, _, column in columns:
        rows[name] = column
    write_ply(points, rows)
    pictures = [
        {"name": name, "world_to_camera": viewmat.tolist(), "lens": lens.plain()}
        for name, viewmat, lens in zip(poses.names, poses.viewmats, poses.lenses)
    ]
    for picture, numbers in zip(pictures, poses.sightings):
        picture["points"] = numbers.tolist()
    error = poses.error if np.isfinite(poses.error) else None
    summary = {"reprojection_error_px": error, "lost": list(poses.lost), "unsure": dict(poses.unsure)}
    write_json(path, {**summary, "pictures": pictures})


def load_poses(path: str | Path, points: str | Path) -> Poses:
    """Read the files of `save_poses`. Raises InputError for other files."""
    data = read_json(path)
    rows, _ = read_ply(points)
    with reading(path, "poses"):
        pictures = data["pictures"]
        return Poses(
            tuple(picture["name"] for picture in pictures),
            tuple(read_lens(picture["lens"], f"{path}: {picture['name']}") for picture in pictures),
            np.array([picture["world_to_camera"] for picture in pictures], np.float64).reshape(-1, 4, 4),
            np.stack([rows[axis] for axis in "xyz"], axis=1).astype(np.float64),
            np.stack([rows[channel] for channel in ("red", "green", "blue")], axis=1),
            np.nan if data["reprojection_error_px"] is None else data["reprojection_error_px"],
            tuple(data["lost"]),
            {name: tuple(values) for name, values in data.get("unsure", {}).items()},
            tuple(np.array(picture["points"], int) for picture in pictures if "points" in picture),
        )


def read_lenses(path: str | Path) -> dict[str, Lens]:
    """Lenses by group from a JSON file: {group: {fl_x, fl_y, cx, cy, w, h, k1, ...}}.

    Raises:
        InputError: names the file, the group and the key.
    """
    values = read_json(path)
    if not isinstance(values, dict) or not values:
        raise InputError(path, "expected intrinsics by name of a camera")
    return {group: read_lens(lens, f"{path}: {one_line(group)}") for group, lens in values.items()}


def structure_from_motion(
    pictures: Mapping[str, Path],
    work: str | Path,
    seed: int = 0,
    threads: int = 1,
    lenses: Mapping[str, Lens] | None = None,
) -> Poses:
    """Cameras and points from overlapping pictures, in a world of arbitrary scale and orientation.

    COLMAP with SIFT features on the CPU, exhaustive matching and incremental mapping. Pictures are numbered before
    their features are computed, and mapping uses one thread, because the order of pictures and sums changes the poses:
    the same seed gives the same result.

    Args:
        pictures: name -> file, `<folder>/<group>/<file>` as written by `copy_pictures`.
        work: folder for COLMAP's files.
        seed: of all random numbers.
        threads: for features and matching, which take longest.
        lenses: known lenses by group, kept fixed. Others are estimated.

    Raises:
        InputError: too few photographs, or `check_registered` fails.
    """
    photographs = [name for name in pictures if group_of(name) == PHOTOGRAPHS]
    if len(photographs) < _MIN_PHOTOGRAPHS:
        raise InputError(
            PHOTOGRAPHS,
            f"{len(photographs)} are too few, at least {_MIN_PHOTOGRAPHS} are required",
            "Take 30 to 60 photographs all around the object, each overlapping the previous one by two thirds",
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
    pycolmap.Database.open(database).close()
    extraction = pycolmap.FeatureExtractionOptions(
        max_image_size=_LARGEST, num_threads=threads, use_gpu=False
    )
    for group in dict.fromkeys(map(group_of, pictures)):
        reader = pycolmap.ImageReaderOptions(
            camera_model=PHOTOGRAPH_MODEL if group == PHOTOGRAPHS else STILL_MODEL
        )
        if group in lenses:
            reader.camera_model = "FULL_OPENCV"
            lens = lenses[group]
            # The denominator coefficients k4 to k6 are 0.
            values = [*lens.K[[0, 1], [0, 1]], *lens.K[:2, 2], *lens.distortion, 0, 0, 0]
            reader.camera_params = ",".join(repr(float(v)) for v in values)
        names = [name for name in pictures if group_of(name) == group]
        pycolmap.import_images(database, root, pycolmap.CameraMode.PER_FOLDER, names, reader)
        pycolmap.extract_features(
            database,
            root,
            image_names=names,
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
    options = _mapping_options(len(photographs), seed)
    with pycolmap.Database.open(database) as opened:
        known = {image.camera_id for image in opened.read_all_images() if group_of(image.name) in lenses}
    options.constant_cameras = known
    models = pycolmap.incremental_mapping(database, root, models_folder, options)
    if not models:
        raise InputError(
            PHOTOGRAPHS,
            "no two photographs could be matched",
            "Check that they are sharp and overlap, and that the floor has texture: lay the printed board or newspapers"
            " under the object",
        )
    best = max(models.values(), key=lambda model: (model.num_reg_images(), model.num_points3D()))
    placed = sum(group_of(best.images[number].name) == PHOTOGRAPHS for number in best.reg_image_ids())
    if placed >= FEW_PHOTOGRAPHS and PHOTOGRAPHS not in lenses:
        best = _refine_lens(best, known)
    poses = _poses_of(best, pictures, lenses)
    if placed >= FEW_PHOTOGRAPHS:
        poses = _resect_stills(poses, best, lenses)
    groups = [{model.images[k].name for k in model.reg_image_ids()} for model in models.values()]
    check_registered(poses, groups)
    return poses


def _refine_lens(model: Any, known: set[int]) -> Any:
    """Refine a reconstruction with a free principal point and non-square pixels for the photographs.

    On synthetic photographs with such a lens, a centred one rotates cameras by the angle of the offset and has a scale
    error of 0.2 %. The lenses of the stills are then refitted to the moved points.

    If the photographs do not determine the lens (all from one side in one orientation, for example), tangential
    distortion, principal point and direction compensate each other, and the result is not `plausible`. The original
    model is returned then.

    Args:
        known: numbers of cameras with fixed lenses.
    """
    pycolmap = colmap()
    refined = copy.deepcopy(model)
    stills = set()
    for number, camera in refined.cameras.items():
        if camera.model.name == PHOTOGRAPH_MODEL:
            f, cx, cy, k1, k2 = camera.params
            camera.model = getattr(pycolmap.CameraModelId, REFINED_MODEL)
            camera.params = [f, f, cx, cy, k1, k2, 0.0, 0.0]
        else:
            stills.add(number)
    options = pycolmap.BundleAdjustmentOptions(print_summary=False)
    options.ceres.solver_options.num_threads = 1
    for offset, constant in ((True, stills | known), (False, known)):
        options.refine_principal_point = offset
        config = pycolmap.BundleAdjustmentConfig()
        config.fix_gauge(pycolmap.BundleAdjustmentGauge.TWO_CAMS_FROM_WORLD)
        for number in refined.reg_image_ids():
            config.add_image(number)
        for number in constant:
            config.set_constant_cam_intrinsics(number)
        done = pycolmap.create_default_bundle_adjuster(options, config, refined).solve()
        lenses = [_lens_of(camera) for number, camera in refined.cameras.items() if number not in constant]
        if not done.is_solution_usable() or not all(map(plausible, lenses)):
            return model
    refined.update_point_3d_errors()
    return refined


def _resect_stills(poses: Poses, model: Any, lenses: Mapping[str, Lens]) -> Poses:
    """Fit each fixed camera with an unknown lens to the points of the photographs."""
    views = {}
    for image in model.images.values():
        if image.name in poses.names:
            seen = [(point.point3D_id, *point.xy) for point in image.points2D if point.has_point3D()]
            views[image.name] = np.array(seen, np.float64).reshape(-1, 3)
    stills = [n for n in poses.names if group_of(n) != PHOTOGRAPHS and group_of(n) not in lenses]
    wanted = np.unique(np.concatenate([views[name][:, 0] for name in stills] or [[]])).astype(np.int64)

    def sighting(name: str) -> Sighting:
        i, seen = poses.names.index(name), views[name]
        seen = seen[np.isin(seen[:, 0], wanted)]
        numbers = np.searchsorted(wanted, seen[:, 0].astype(np.int64))
        return Sighting(poses.lenses[i], poses.viewmats[i], numbers, seen[:, 1:])

    if len(wanted) == 0:
        return poses
    photographs = [sighting(name) for name in poses.names if group_of(name) == PHOTOGRAPHS]
    first = np.array([model.points3D[int(number)].xyz for number in wanted])
    points, covariances, known = triangulated(first, photographs)
    viewmats, new_lenses, unsure = poses.viewmats.copy(), list(poses.lenses), {}
    for name in stills:
        i, seen = poses.names.index(name), sighting(name)
        usable = known[seen.points]
        numbers = seen.points[usable]
        if usable.sum() < MIN_POINTS:
            continue
        camera = resect(points[numbers], covariances[numbers], seen.pixels[usable], seen.lens, seen.viewmat)
        if plausible(camera.lens):
            viewmats[i], new_lenses[i] = camera.viewmat, camera.lens
            unsure[name] = (*camera.centre_deviation.tolist(), camera.turn_deviation)
    return replace(poses, viewmats=viewmats, lenses=tuple(new_lenses), unsure=unsure)


def plausible(lens: Lens) -> bool:
    """Whether the principal point and the pixel aspect of a lens are in the range of phones."""
    off_centre = np.abs(lens.K[:2, 2] - [lens.width / 2, lens.height / 2]).max()
    stretch = abs(lens.K[0, 0] / lens.K[1, 1] - 1)
    return bool(off_centre < MAX_OFF_CENTRE * max(lens.width, lens.height) and stretch < _MAX_STRETCH)


def check_registered(poses: Poses, groups: Sequence[Collection[str]] = ()) -> None:
    """Raises InputError unless enough photographs and all fixed cameras are registered.

    Args:
        groups: names of the pictures of each reconstruction. Several mean that the pictures show different scenes.
    """
    lost = [name for name in poses.lost if group_of(name) == PHOTOGRAPHS]
    placed = sum(group_of(name) == PHOTOGRAPHS for name in poses.names)
    other = max((sorted(set(lost) & set(group)) for group in groups), key=len, default=[])
    if placed < _MIN_REGISTERED * (placed + len(lost)) and len(other) >= _MIN_GROUP:
        own = [name for name in poses.names if group_of(name) == PHOTOGRAPHS]
        raise InputError(
            PHOTOGRAPHS,
            f"they show two scenes without common points: {len(own)} as {_some(own, 3)}, and {len(other)} as"
            f" {_some(other, 3)}",
            "Put the photographs of another object into another capture. If the object was moved in between, use one"
            " group alone, with more photographs. If it is one scene, add photographs between the two groups",
        )
    if placed < _MIN_REGISTERED * (placed + len(lost)):
        raise InputError(
            PHOTOGRAPHS,
            f"{placed} of {placed + len(lost)} were registered (not {_some(lost)}), at least {_MIN_REGISTERED:.0%} are"
            " required",
            "Take more photographs, all around and at two heights, in focus, with nothing moved in between",
        )
    for name in poses.lost:
        if group_of(name) != PHOTOGRAPHS:
            raise InputError(
                name,
                "the fixed camera could not be registered among the photographs",
                "Take some photographs from its position in the same light. Or lay the board into its view, give its"
                " `lens` and set poses: board",
            )


def _some(names: Sequence[str], most: int = 5) -> str:
    more = f" and {len(names) - most} more" if len(names) > most else ""
    return ", ".join(name.split("/")[-1] for name in names[:most]) + more


def _mapping_options(photographs: int, seed: int):
    options = colmap().IncrementalPipelineOptions()
    options.random_seed = options.mapper.random_seed = options.triangulation.random_seed = seed
    options.num_threads = 1
    options.min_model_size = 3
    options.extract_colors = True
    if photographs < FEW_PHOTOGRAPHS:
        options.mapper.init_min_num_inliers = 50
        options.mapper.abs_pose_min_num_inliers = 15
        options.mapper.init_min_tri_angle = 8.0
    return options


def _lens_of(camera: Any) -> Lens:
    return lens_of_colmap(camera.model.name, camera.params, camera.width, camera.height)


def _poses_of(model: Any, pictures: Mapping[str, Path], lenses: Mapping[str, Lens]) -> Poses:
    """Poses from COLMAP's reconstruction."""
    images = {model.images[number].name: model.images[number] for number in model.reg_image_ids()}
    names = tuple(name for name in pictures if name in images)
    viewmats = np.tile(np.eye(4), (len(names), 1, 1))
    own_lenses = []
    for viewmat, name in zip(viewmats, names):
        viewmat[:3] = images[name].cam_from_world().matrix()
        own_lenses.append(lenses.get(group_of(name)) or _lens_of(images[name].camera))
    numbers = sorted(model.points3D)
    points = [model.points3D[number] for number in numbers]
    sightings = []
    for name in names:
        visible = {point.point3D_id for point in images[name].points2D if point.has_point3D()}
        sightings.append(np.flatnonzero(np.isin(numbers, list(visible))))
    return Poses(
        names,
        tuple(own_lenses),
        viewmats,
        np.array([point.xyz for point in points]).reshape(-1, 3),
        np.array([point.color for point in points], np.uint8).reshape(-1, 3),
        float(model.compute_mean_reprojection_error()),
        tuple(name for name in pictures if name not in images),
        sightings=tuple(sightings),
    )


def poses_from_board(
    detections: Mapping[str, Detection],
    lenses: Mapping[str, Lens],
    board: BoardConfig,
    listed_in: str | Path | None = None,
) -> Poses:
    """Cameras from the board in each picture, in the board's frame [m]. Photographs that do not show it are lost.

    Args:
        detections: corners by picture.
        lenses: by group.
        listed_in: file of the lenses for messages.

    Raises:
        InputError: a group without a lens, a fixed camera that does not see the board, or too few photographs that do.
    """
    names, poses, errors, lost = [], [], [], []
    for name, corners in detections.items():
        if group_of(name) not in lenses:
            raise InputError(
                listed_in or "lens",
                f"no lens for '{group_of(name)}', which poses: board requires; known: {', '.join(lenses)}",
            )
        try:
            pose, error = board_pose(corners, board, lenses[group_of(name)], name)
        except InputError:
            if group_of(name) != PHOTOGRAPHS:
                raise
            lost.append(name)
        else:
            names.append(name)
            poses.append(pose)
            errors.append(error)
    if not names:
        problem = f"none of {len(detections)} pictures shows the board"
        raise InputError("board", problem, "Lay it uncovered next to the object")
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
    """Cameras of a transforms.json that lists the pictures, in metres, y up, the floor at y = 0.

    Pictures are matched by the end of ``file_path``: `<group>/<file>`, or the file name alone. Distortion k1, k2, p1,
    p2, k3 is set for a frame or for the file.

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
        size = dict(zip("wh", picture_size(file)))
        lens = read_lens({**_centred(frame, **size), **size}, f"{path}: {name}")
        if (frame.get("w", lens.width), frame.get("h", lens.height)) != (lens.width, lens.height):
            problem = f"w, h do not match the picture of {lens.width}x{lens.height} pixels"
            raise InputError(f"{path}: {name}", problem)
        names.append(name)
        lenses.append(lens)
        viewmats.append(np.linalg.inv(np.array(frame["transform_matrix"], np.float64) @ OPENGL_TO_OPENCV))
    if lost:
        raise InputError(path, f"no frame for {_some(lost)}", "Add it, or remove the picture")
    nothing = np.empty((0, 3))
    return Poses(tuple(names), tuple(lenses), np.stack(viewmats), nothing, nothing.astype(np.uint8), np.nan)


def _centred(frame: Mapping[str, Any], w: int, h: int) -> dict[str, Any]:
    """Intrinsics of a frame, completed by defaults for what transforms.json may omit."""
    known = ("fl_x", "fl_y", "cx", "cy", "k1", "k2", "p1", "p2", "k3")
    values = {key: frame[key] for key in known if key in frame}
    focal = values.get("fl_x")
    if focal is None and "camera_angle_x" in frame:
        focal = 0.5 * w / np.tan(0.5 * frame["camera_angle_x"])
    return {"fl_x": focal, "fl_y": focal, "cx": w / 2, "cy": h / 2, **values}
