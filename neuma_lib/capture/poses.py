"""Where the cameras stood: from the photographs together (structure from motion), from the board alone, or as given."""

from __future__ import annotations

import copy
import shutil
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from neuma_lib.capture.board import Detection, board_pose, find_board
from neuma_lib.capture.folder import PHOTOGRAPHS
from neuma_lib.capture.lens import Lens, lens_of_colmap, read_lens
from neuma_lib.capture.pictures import copy_pictures, group_of, name_pictures, picture_size, read_picture
from neuma_lib.capture.placement import Similarity
from neuma_lib.capture.resection import LEAST_POINTS, Sighting, resect, triangulated
from neuma_lib.capture.tools import colmap
from neuma_lib.config.capture import BoardConfig
from neuma_lib.errors import InputError
from neuma_lib.io.files import one_line, read_json, reading, write_json
from neuma_lib.io.images import OPENGL_TO_OPENCV, read_transforms
from neuma_lib.io.ply import read_ply, write_ply

LEAST_PHOTOGRAPHS = 8
"""Fewest photographs that structure from motion is tried with."""
FEW_PHOTOGRAPHS = 20
"""Below this many, it begins with less (`_mapping_options`), and less is asked of the lens (`_lens_refined`)."""
LEAST_REGISTERED = 0.7
"""Least share of the photographs that must find their place."""
LARGEST = 2400
"""Longer side at which features are sought [px]."""
PHOTOGRAPH_MODEL, STILL_MODEL = "RADIAL", "SIMPLE_RADIAL"
"""COLMAP's camera models in the search, with square pixels and a centred lens: on ten photographs a second focal length
went 4 % astray."""
REFINED_MODEL = "OPENCV"
"""That of the photographs in the end, with a lens off the centre, where there are enough of them."""
MOST_OFF_CENTRE = 0.02
"""How far a phone's lens is off the centre, as share of the longer side; found further off, it is not determined."""
MOST_STRETCH = 0.01
"""How much the focal lengths of the two sides differ at most, as share of either."""


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
        unsure: of pictures of fixed cameras whose lens was found, by name: deviations of the lens's centre in x and y
            [px], and of the direction about its worst axis [degrees].
    """

    names: tuple[str, ...]
    lenses: tuple[Lens, ...]
    viewmats: np.ndarray
    points: np.ndarray
    colours: np.ndarray
    error: float
    lost: tuple[str, ...] = ()
    unsure: Mapping[str, tuple[float, float, float]] = field(default_factory=dict)

    def moved(self, by: Similarity) -> Poses:
        """The same, with all of the world moved."""
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
        source: how: `photographs`, `board`, or a transforms.json.
        work: folder for copies of the pictures and for COLMAP's files.
        lenses: file of `read_lenses`.
        board: for the source `board`.
        seed, threads: see `structure_from_motion`.

    Raises:
        InputError: see the functions that it calls; a lens of another size than its pictures.
    """
    pictures = name_pictures(groups)
    known = read_lenses(lenses) if lenses else {}
    for name, file in pictures.items():
        if (lens := known.get(group_of(name))) is not None:
            size = picture_size(file)
            if size != (lens.width, lens.height):
                raise InputError(
                    f"{lenses}: the lens of '{group_of(name)}' is of {lens.width}x{lens.height} pixels, {file} has "
                    f"{size[0]}x{size[1]}: calibrate at this size"
                )
    if source == "photographs":
        copies = copy_pictures(pictures, Path(work) / "pictures")
        return structure_from_motion(copies, Path(work) / "colmap", seed, threads, known)
    if source == "board":
        return poses_from_board(find_boards(pictures, board), known, board, lenses)
    return given_poses(source, pictures)


def find_boards(pictures: Mapping[str, Path], board: BoardConfig) -> dict[str, Detection]:
    """Corners of the board in every picture, by name."""
    return {name: find_board(read_picture(file), board) for name, file in pictures.items()}


def save_poses(path: str | Path, points: str | Path, poses: Poses) -> None:
    """Write cameras as JSON, and points as PLY, which viewers of meshes open."""
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
    error = poses.error if np.isfinite(poses.error) else None
    said = {"reprojection_error_px": error, "lost": list(poses.lost), "unsure": dict(poses.unsure)}
    write_json(path, {**said, "pictures": pictures})


def load_poses(path: str | Path, points: str | Path) -> Poses:
    """What `save_poses` wrote. Raises InputError for a file that it did not write."""
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
        )


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

    SIFT features on the CPU, every picture matched with every other, incremental mapping (COLMAP). Features and mapping
    keep to one thread, since pictures in another order, or sums, give other poses: the same seed gives the same result.

    Args:
        pictures: name -> file, `<folder>/<group>/<file>` as `copy_pictures` lays them out.
        work: folder for COLMAP's files.
        seed: of all random draws.
        threads: processors for matches, which take the longest.
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
    extraction = pycolmap.FeatureExtractionOptions(max_image_size=LARGEST, num_threads=1, use_gpu=False)
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
    options = _mapping_options(len(photographs), seed)
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
    placed = sum(group_of(best.images[number].name) == PHOTOGRAPHS for number in best.reg_image_ids())
    if placed >= FEW_PHOTOGRAPHS and PHOTOGRAPHS not in lenses:
        best = _lens_refined(best, known)
    poses = _poses_of(best, pictures, lenses)
    if placed >= FEW_PHOTOGRAPHS:
        poses = _stills_resected(poses, best, lenses)
    check_registered(poses)
    return poses


def _lens_refined(model: Any, known: set[int]) -> Any:
    """A reconstruction whose lens of the photographs may be off the centre and have pixels that are not square.

    On drawn photographs with such a lens, a centred one turns cameras by the angle of its offset and errs by 0.2 % in
    the scale. Afterwards the lenses of the stills fit the moved points once more.

    Where the photographs do not tell it (all from one side and held alike, for example), tangential distortion, centre
    and direction stand in for each other, and no real phone has the lens that comes out (`plausible`). The model then
    stays as it is.

    Args:
        known: numbers of cameras whose lenses are kept.
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


def _stills_resected(poses: Poses, model: Any, lenses: Mapping[str, Lens]) -> Poses:
    """Poses in which each fixed camera whose lens is not known has been fitted to the points of the photographs."""
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
    viewmats, found, unsure = poses.viewmats.copy(), list(poses.lenses), {}
    for name in stills:
        i, seen = poses.names.index(name), sighting(name)
        told = known[seen.points]
        numbers = seen.points[told]
        if told.sum() < LEAST_POINTS:
            continue
        camera = resect(points[numbers], covariances[numbers], seen.pixels[told], seen.lens, seen.viewmat)
        if plausible(camera.lens):
            viewmats[i], found[i] = camera.viewmat, camera.lens
            unsure[name] = (*camera.centre_deviation.tolist(), camera.turn_deviation)
    return replace(poses, viewmats=viewmats, lenses=tuple(found), unsure=unsure)


def plausible(lens: Lens) -> bool:
    """Whether a lens is as little off the centre of its pictures, and as little stretched, as those of phones are."""
    off = np.abs(lens.K[:2, 2] - [lens.width / 2, lens.height / 2]).max()
    stretch = abs(lens.K[0, 0] / lens.K[1, 1] - 1)
    return bool(off < MOST_OFF_CENTRE * max(lens.width, lens.height) and stretch < MOST_STRETCH)


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
    """What this project keeps of COLMAP's reconstruction."""
    images = {model.images[number].name: model.images[number] for number in model.reg_image_ids()}
    names = tuple(name for name in pictures if name in images)
    viewmats = np.tile(np.eye(4), (len(names), 1, 1))
    found = []
    for viewmat, name in zip(viewmats, names):
        viewmat[:3] = images[name].cam_from_world().matrix()
        found.append(lenses.get(group_of(name)) or _lens_of(images[name].camera))
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
    found: Mapping[str, Detection],
    lenses: Mapping[str, Lens],
    board: BoardConfig,
    listed_in: str | Path | None = None,
) -> Poses:
    """Cameras from the board in each picture, in the board's frame [m]; photographs that do not show it are lost.

    Args:
        found: corners by picture.
        lenses: by group.
        listed_in: file of the lenses, for messages.

    Raises:
        InputError: a group without a lens; a fixed camera that does not see the board; too few photographs that do.
    """
    names, poses, errors, lost = [], [], [], []
    for name, corners in found.items():
        if group_of(name) not in lenses:
            raise InputError(
                f"{listed_in}: no lens for '{group_of(name)}', which poses: board needs; known: "
                f"{', '.join(lenses)}"
            )
        try:
            pose, error = board_pose(corners, board, lenses[group_of(name)], name)
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
        size = dict(zip("wh", picture_size(file)))
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
