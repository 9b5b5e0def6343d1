"""Compare results of the pipeline for a demo capture with the ground truth, in metres of the simulation box."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from neuma_lib.capture.calibration.lens import Lens, read_lens
from neuma_lib.capture.calibration.placement import fit_similarity
from neuma_lib.capture.masks.regions import iou
from neuma_lib.capture.pictures import undistorted
from neuma_lib.capture.tools import opencv
from neuma_lib.geometry.skinning import skinning_matrix
from neuma_lib.io.images import read_image_set, read_transforms
from studies.capture_benchmark.room import Moving

FINER = 4  # supersampling factor of silhouettes
EVERY = 4  # stride of the video frames that are compared with true silhouettes


@dataclass(frozen=True)
class Row:
    """One comparison.

    Attributes:
        what: name of the quantity.
        value: its error, or a quality (IoU, a ratio).
        unit: of the value.
        goal: limit of the value, if any.
        minimum: whether the goal is a lower limit.
    """

    what: str
    value: float
    unit: str
    goal: float | None = None
    minimum: bool = False

    @property
    def reached(self) -> bool | None:
        if self.goal is None:
            return None
        return bool(self.value >= self.goal if self.minimum else self.value <= self.goal)


@dataclass(frozen=True, eq=False)
class Truth:
    """The true motion of a drop, with a frame for each frame of each camera.

    Attributes:
        times: since the start [s], (T,).
        x: particles [m], (T, N, 3).
        mass: [kg], (N,).
        tracers: [m], (T, M, 3).
    """

    times: np.ndarray
    x: np.ndarray
    mass: np.ndarray
    tracers: np.ndarray

    def center(self, frame: int) -> np.ndarray:
        """Centre of mass [m], (3,)."""
        return self.mass @ self.x[frame].astype(np.float64) / self.mass.sum()

    def turn(self, frame: int) -> Rotation:
        """Least-squares rotation from the start to a frame."""
        first, now = (self.x[k].astype(np.float64) - self.center(k) for k in (0, frame))
        return Rotation.align_vectors(now, first)[0]


@dataclass(frozen=True, eq=False)
class Flying:
    """True rigid motion in flight: centre of mass [m], rotation from the start, velocity [m/s], spin [rad/s]."""

    center: np.ndarray
    turn: Rotation
    velocity: np.ndarray
    spin: np.ndarray


def flying(truth: Truth, time: float, velocity: Sequence[float], gravity: Sequence[float]) -> Flying:
    """The true motion at a time before contact [s], from velocity [m/s] and gravity [m/s^2] at the start."""
    k = int(np.clip(np.searchsorted(truth.times, time), 1, len(truth.times) - 1))
    before, after = truth.turn(k - 1), truth.turn(k)
    spin = (after * before.inv()).as_rotvec() / (truth.times[k] - truth.times[k - 1])
    turn = Rotation.from_rotvec(spin * (time - truth.times[k - 1])) * before
    v0, g = np.asarray(velocity, float), np.asarray(gravity, float)
    return Flying(truth.center(0) + v0 * time + g * time * time / 2, turn, v0 + g * time, spin)


def angle(a: np.ndarray, b: np.ndarray) -> float:
    """Angle between two directions (3,) [degrees]."""
    a, b = np.asarray(a, float) / np.linalg.norm(a), np.asarray(b, float) / np.linalg.norm(b)
    return float(np.degrees(2 * np.arcsin(np.clip(np.linalg.norm(a - b) / 2, 0, 1))))


def compare_cameras(
    frames: Sequence[Mapping[str, Any]], photographs: Mapping[str, Any], cameras: Mapping[str, Any]
) -> list[Row]:
    """Errors of the cameras in a room's transforms.json, given true ones by file stem and by camera."""
    rows, centres, true_centres = [], [], []
    for kind in ("photographs", "video cameras"):
        centre, turn = [], []
        for frame in frames:
            if (frame["group"] == "photographs") != (kind == "photographs"):
                continue
            stem = frame["file_path"].rpartition("/")[2].rpartition(".")[0]
            known = photographs[stem] if kind == "photographs" else cameras[frame["group"]]
            pose, true = (np.array(entry["transform_matrix"]) for entry in (frame, known))
            centres.append(pose[:3, 3])
            true_centres.append(true[:3, 3])
            centre.append(1000 * np.linalg.norm(pose[:3, 3] - true[:3, 3]))
            turn.append(np.degrees(Rotation.from_matrix(pose[:3, :3] @ true[:3, :3].T).magnitude()))
        if centre:
            rows.append(Row(f"centres of {kind}, largest", max(centre), "mm", 5.0))
            rows.append(Row(f"directions of {kind}, largest", max(turn), "degrees", 0.2))
    placed = fit_similarity(np.stack(centres), np.stack(true_centres))
    rows.append(Row("scale, from the cameras", 100 * abs(1 / placed.scale - 1), "%", 0.5))
    rows.append(Row("up, from the cameras", angle(placed.rotation @ [0, 1, 0], [0, 1, 0]), "degrees", 0.5))
    return rows


def silhouette(vertices: np.ndarray, faces: np.ndarray, c2w: np.ndarray, lens: Lens) -> np.ndarray:
    """Pixels of a picture, (H, W), of which a mesh (n, 3) [m], (m, 3) covers at least half."""
    cv2 = opencv()
    seen = (vertices - c2w[:3, 3]) @ c2w[:3, :3] * [1.0, -1.0, -1.0]
    corners = np.rint(FINER * lens.project(seen) * 16 - 8).astype(np.int32)[faces]
    fine = np.zeros((FINER * lens.height, FINER * lens.width), np.uint8)
    for triangle in corners:
        cv2.fillConvexPoly(fine, triangle, 255, shift=4)
    blocks = fine.reshape(lens.height, FINER, lens.width, FINER)
    return blocks.mean(axis=(1, 3)) >= 127.5


def mask_agreement(
    alpha: np.ndarray,
    vertices: np.ndarray,
    faces: np.ndarray,
    true: Mapping[str, Any],
    lens: Lens,
    longest: int,
) -> float:
    """IoU of a matte's mask with the true silhouette, in the undistorted picture of the pipeline.

    Args:
        alpha: of the matte, (H, W), uint8.
        vertices, faces: mesh of the body at the time of the picture.
        true: true camera of the picture, pose and lens.
        lens: estimated lens.
        longest: longer side of the undistorted pictures [px].
    """
    whole = silhouette(vertices, faces, np.array(true["transform_matrix"]), true_lens(true))
    drawn = undistorted(np.repeat(255 * whole[..., None].astype(np.uint8), 3, axis=2), lens, longest)[..., 0]
    return iou(alpha > 127, drawn > 127)


def mattes(path: str | Path) -> list[tuple[dict[str, Any], np.ndarray]]:
    """Entries of a set of mattes, each with its opacity (H, W), uint8."""
    return list(zip(read_transforms(path)["frames"], read_image_set(path).images[..., 3]))


def photograph_agreement(
    path: str | Path, rest: Moving, known: Mapping[str, Any], lens: Lens, longest: int
) -> list[float]:
    """IoU of the masks of photographs with the truth.

    Args:
        path: transforms.json of the mattes.
        rest: the body at rest.
        known: true cameras by stem of the file.
        lens, longest: as of `mask_agreement`.
    """
    return [
        mask_agreement(
            alpha, rest.vertices[0], rest.faces, known[Path(frame["file_path"]).stem], lens, longest
        )
        for frame, alpha in mattes(path)
    ]


def video_agreement(
    path: str | Path,
    body: Moving,
    numbers: np.ndarray,
    true: Mapping[str, Any],
    lens: Lens,
    longest: int,
    repeats: int = 1,
) -> list[float]:
    """IoU of the masks of every fourth frame of a camera with the truth.

    Args:
        path: transforms.json of the mattes.
        body, numbers: the body, and the numbers of its frames at those of the video.
        true: camera.
        lens, longest: as of `mask_agreement`.
        repeats: how often the video stores each picture.
    """
    return [
        mask_agreement(
            alpha, body.vertices[numbers[frame["step"] // repeats]], body.faces, true, lens, longest
        )
        for frame, alpha in mattes(path)[::EVERY]
    ]


def true_lens(camera: Mapping[str, Any]) -> Lens:
    """The lens of a camera of truth.json."""
    return read_lens(
        {key: value for key, value in camera.items() if key not in ("transform_matrix", "light", "offset_s")},
        "truth.json",
    )


def compare_masks(agreements: Mapping[str, Sequence[float]]) -> list[Row]:
    """IoU of masks with the truth, for photographs and each camera."""
    rows = []
    for kind, values in agreements.items():
        rows.append(Row(f"IoU of masks, {kind}, mean", float(np.mean(values)), "", 0.96, minimum=True))
        rows.append(Row(f"IoU of masks, {kind}, least", float(np.min(values)), ""))
    return rows


def compare_flight(flight: Mapping[str, Any], known: Mapping[str, Any], truth: Truth, drop: str) -> list[Row]:
    """Errors of a flight/<take>.json, given the truth.json."""
    first = min(flight["offsets_s"])
    late = {name: camera["offset_s"] for name, camera in known["cameras"].items()}
    true_drop = known["drops"][drop]
    now = flying(truth, late[first] + flight["start_s"], true_drop["v0_m_s"], known["gravity_m_s2"])
    rows = [
        *_gravity(flight, known, "outlines"),
        Row("v0 of the masks' centre", 100 * _relative_error(flight["v0_m_s"], now.velocity), "%"),
    ]
    for name, offset in flight["offsets_s"].items():
        if name != first:
            error = abs(offset - (late[name] - late[first]))
            rows.append(Row(f"offset of {name}, from the fall", 1000 * error, "ms"))
    if flight["spin_rad_s"]:
        error = float(np.linalg.norm(np.subtract(flight["spin_rad_s"], now.spin)))
        rows.append(Row("spin, from points", error, "rad/s"))
    return rows


def _gravity(
    report: Mapping[str, Any], known: Mapping[str, Any], source: str, goal: float | None = None
) -> list[Row]:
    turn = angle(report["gravity_m_s2"], known["gravity_m_s2"])
    return [
        Row(f"direction of gravity, from {source}", turn, "degrees", goal),
        Row(f"size of gravity, from {source}", 100 * abs(report["gravity_ratio"] - 1), "%"),
    ]


def compare_registration(
    registration: Mapping[str, Any],
    velocity: Mapping[str, Any] | None,
    known: Mapping[str, Any],
    truth: Truth,
    drop: str,
) -> list[Row]:
    """Errors of a registration.json and its velocity.json."""
    first = min(registration["offsets_s"])
    late = {name: camera["offset_s"] for name, camera in known["cameras"].items()}
    true_drop = known["drops"][drop]
    now = flying(truth, late[first] + registration["t0_s"], true_drop["v0_m_s"], known["gravity_m_s2"])
    rotation, translation = (np.array(registration[key]) for key in ("rotation", "translation"))
    turn, shift = np.array(true_drop["rotation"]), np.array(true_drop["translation"])
    start = np.array(true_drop["center_m"])
    photographed = turn.T @ (start - shift)  # centre of mass in the photographs
    true_turn = now.turn.as_matrix() @ turn
    distance = float(np.linalg.norm(rotation @ photographed + translation - now.center))
    turned = float(np.degrees(Rotation.from_matrix(rotation @ true_turn.T).magnitude()))
    rows = [
        Row("registration, place", 1000 * distance, "mm", 3.0),
        Row("registration, turn", turned, "degrees", 1.5),
    ]
    rows += _gravity(registration, known, "the placed object", 0.5)
    for name, offset in registration["offsets_s"].items():
        if name != first:
            rows.append(Row(f"offset of {name}", 1000 * abs(offset - (late[name] - late[first])), "ms"))
    if velocity is not None:
        rows.append(Row("v0", 100 * _relative_error(velocity["v0"], now.velocity), "%", 3.0))
        if velocity.get("angular_velocity"):
            error = float(np.linalg.norm(np.subtract(velocity["angular_velocity"], now.spin)))
            rows.append(Row("spin", error, "rad/s"))
    return rows


def tracer_error(x: np.ndarray, times: np.ndarray, truth: Truth, start: float) -> float:
    """Root-mean-square distance between true tracers and their predicted motion [m].

    Args:
        x: predicted particles [m], (T, N, 3), the first at the start of the prediction.
        times: since that start [s], (T,).
        start: of the prediction, relative to the start of the truth [s].
    """
    starts = _between(truth.tracers, truth.times, start)
    matrix = skinning_matrix(starts, x[0])
    squares = []
    for state, time in zip(x[1:], times[1:]):
        if start + time <= truth.times[-1]:
            error = matrix @ state.astype(np.float64) - _between(truth.tracers, truth.times, start + time)
            squares.append((error**2).sum(axis=1).mean())
    return float(np.sqrt(np.mean(squares)))


def _between(values: np.ndarray, times: np.ndarray, time: float) -> np.ndarray:
    """Linear interpolation of values (T, ...) in time."""
    k = int(np.clip(np.searchsorted(times, time), 1, len(times) - 1))
    share = np.clip((time - times[k - 1]) / (times[k] - times[k - 1]), 0, 1)
    return (1 - share) * values[k - 1].astype(np.float64) + share * values[k].astype(np.float64)


def _relative_error(value: Sequence[float], true: Sequence[float]) -> float:
    return float(np.linalg.norm(np.subtract(value, true)) / np.linalg.norm(true))


def compare_motion(errors: Mapping[str, float], prior: str, held_out: bool) -> list[Row]:
    """Tracer errors [m] of predictions of a drop, by method. ``prior`` evaluates the unchanged prior."""
    rows = []
    for method, error in errors.items():
        goal = None if method == prior else 15.0 if held_out else 12.0
        rows.append(Row(f"tracer RMSE, {method}", 1000 * error, "mm", goal))
        if method != prior and prior in errors and not held_out:
            ratio = errors[prior] / error
            rows.append(Row(f"prior's RMSE over that of {method}", ratio, "", 4.0, minimum=True))
    return rows


def table(rows: Sequence[tuple[str, str, Row]]) -> tuple[str, list[list[str]]]:
    """Markdown and cells of rows, each with its capture and drop ("" for rows of the whole capture)."""
    head = ["capture", "drop", "what", "found", "goal", ""]
    cells = []
    for capture, drop, row in rows:
        goal = "" if row.goal is None else f"{'>=' if row.minimum else '<='} {row.goal:g} {row.unit}".strip()
        reached = {None: "", True: "reached", False: "missed"}[row.reached]
        cells.append([capture, drop, row.what, f"{row.value:.3g} {row.unit}".strip(), goal, reached])
    lines = [head, ["---"] * len(head), *cells]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines) + "\n", [head, *cells]
