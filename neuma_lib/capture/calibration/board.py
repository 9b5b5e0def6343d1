"""ChArUco board: print, detect, and use it to determine scale, floor and vertical direction.

Frame of the board: origin at the lower left corner of the squares, x to the right, y up the page, z out of the print,
in metres. (In OpenCV, y points down the page and z into the table.) On the floor, face up, z is up.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from neuma_lib.capture.calibration.lens import HALF_PIXEL, Lens
from neuma_lib.capture.calibration.placement import Similarity, fit_similarity, project, triangulate
from neuma_lib.capture.tools import opencv
from neuma_lib.config.board import PAPERS, BoardConfig
from neuma_lib.errors import InputError
from neuma_lib.extras import require
from neuma_lib.io.files import atomic

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_MARGIN = 0.010  # unprintable border of the page [m]
_FOOT = 0.024  # strip under the squares for the ruler and the text [m]
_RULER = 0.100  # length of the printed ruler [m]
_MIN_CORNERS = 6  # corners required for a pose
NEIGHBOURS = 13  # number of nearest corners, including itself, used to predict the position of a corner
NEIGHBOUR_TOLERANCE = (0.4, 0.005)
"""Tolerated distance of a corner from its prediction: pixels, and share of a square's side."""
MIN_ANGLE = np.deg2rad(3.0)
"""Angle between rays required to triangulate a corner. Smaller angles determine its distance poorly."""
_MAX_PIXELS = 2.0  # tolerated root-mean-square reprojection error of a pose [px]
MAX_MISFIT = 0.05
"""Tolerated root-mean-square misfit of the board's corners [squares]. A bent or moved print exceeds it."""
Y_UP = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])
"""Rotation from z up to y up, by -90 degrees about x."""


@dataclass(frozen=True, eq=False)
class Detection:
    """Corners of the board in a picture: OpenCV's numbers (N,), and pixels (N, 2) with centres at +0.5."""

    ids: np.ndarray
    pixels: np.ndarray


@dataclass(frozen=True, eq=False)
class BoardFit:
    """Pose and scale of the board in a reconstruction."""

    board_from_world: Similarity  # the similarity from the reconstruction to the board's frame
    corners: np.ndarray  # numbers of the corners used, (N,)
    residual: float  # root-mean-square distance between triangulated and printed corners [m]
    flatness: float  # its component normal to the print [m]
    pictures: int  # number of pictures that show the board

    def plain(self) -> dict:
        """Entries of a report, lengths in millimetres."""
        return {
            "corners": len(self.corners),
            "pictures": self.pictures,
            "residual_mm": 1000 * self.residual,
            "flatness_mm": 1000 * self.flatness,
            "metres_per_unit": self.board_from_world.scale,
        }


def corner_positions(board: BoardConfig) -> np.ndarray:
    """Inner corners of the chessboard in the board's frame, indexed by their numbers, (N, 3) [m]."""
    columns, rows = board.squares
    j, i = np.mgrid[1:rows, 1:columns]
    flat = np.stack([i, rows - j, np.zeros_like(i)], axis=-1).reshape(-1, 3)
    return board.square * flat.astype(np.float64)


def black_rectangles(board: BoardConfig) -> tuple[np.ndarray, np.ndarray]:
    """Rectangles to print, in the board's frame.

    Returns:
        Black rectangles, and white ones drawn over them, as x, y of the lower left corner, width and height [m],
        (N, 4) each. White rectangles overlap to avoid hair lines.
    """
    cv2 = opencv()
    dictionary = _dictionary(board)
    columns, rows = board.squares
    side = board.marker
    black, white = [], []
    number = 0
    for row in range(rows):  # from the top of the page
        for column in range(columns):
            left, bottom = column, rows - 1 - row
            if (row + column) % 2 == 0:
                black.append((left, bottom, 1.0, 1.0))
                continue
            bits = dictionary.markerSize + 2
            picture = cv2.aruco.generateImageMarker(dictionary, number, bits, borderBits=1)
            number += 1
            x0, y1 = left + (1 - side) / 2, bottom + (1 + side) / 2
            black.append((x0, y1 - side, side, side))
            bit = side / bits
            for first, last, line in _runs(picture > 127):
                white.append((x0 + first * bit, y1 - (line + 1) * bit, (last - first) * bit, bit))
            for first, last, line in _runs((picture > 127).T):
                white.append((x0 + line * bit, y1 - last * bit, bit, (last - first) * bit))
    return board.square * np.array(black), board.square * np.array(white)


def _runs(picture: np.ndarray) -> list[tuple[int, int, int]]:
    """Runs of ones: start, end (exclusive) and row."""
    runs = []
    for line, row in enumerate(picture):
        edges = np.flatnonzero(np.diff(np.concatenate([[0], row.astype(int), [0]])))
        runs += [(int(a), int(b), line) for a, b in zip(edges[::2], edges[1::2])]
    return runs


def print_board(path: str | Path, board: BoardConfig, paper: str = "A4") -> None:
    """Write a PDF page with the board at its true size, and a ruler. Raises InputError if it does not fit."""
    page = board_page(board, paper)
    canvas = require("matplotlib.backends.backend_pdf", "capture").FigureCanvasPdf(page)
    with atomic(path) as partial:
        canvas.print_pdf(partial, metadata={"CreationDate": None, "Title": "ChArUco board"})


def board_page(board: BoardConfig, paper: str) -> "Figure":
    """The page of `print_board`, with axes in millimetres from the lower left corner."""
    if paper not in PAPERS:
        raise InputError("paper", f"unknown size {paper!r}", f"Use one of {', '.join(PAPERS)}")
    width, height = PAPERS[paper]
    columns, rows = board.squares
    room = min((width - 2 * _MARGIN) / columns, (height - 2 * _MARGIN - _FOOT) / rows)
    if board.square > room:
        raise InputError(
            "board.square",
            f"{columns} x {rows} squares of {1000 * board.square:.1f} mm do not fit on {paper}, the maximum is"
            f" {int(1000 * room)} mm",
            f"Reduce board.square or board.squares{', or print on A3' if paper == 'A4' else ''}",
        )
    Rectangle = require("matplotlib.patches", "capture").Rectangle
    figure = require("matplotlib.figure", "capture").Figure(figsize=(width / 0.0254, height / 0.0254))
    axes = figure.add_axes((0, 0, 1, 1))
    axes.set(xlim=(0, 1000 * width), ylim=(0, 1000 * height))
    axes.axis("off")
    left = (width - columns * board.square) / 2
    bottom = _MARGIN + _FOOT + (height - 2 * _MARGIN - _FOOT - rows * board.square) / 2
    black, white = black_rectangles(board)
    for rectangles, colour in ((black, "black"), (white, "white")):
        for x, y, w, h in 1000 * (rectangles + [left, bottom, 0, 0]):
            axes.add_patch(Rectangle((x, y), w, h, facecolor=colour, linewidth=0))
    start, line = 1000 * _MARGIN, 1000 * (_MARGIN + 0.010)
    axes.add_patch(Rectangle((start, line), 1000 * _RULER, 0.3, facecolor="black", linewidth=0))
    for millimetre in range(0, round(1000 * _RULER) + 1, 5):
        tall = 4.0 if millimetre % 50 == 0 else 2.5 if millimetre % 10 == 0 else 1.5
        axes.add_patch(Rectangle((start + millimetre - 0.1, line), 0.2, tall, facecolor="black", linewidth=0))
    axes.text(start, line + 5, "0", fontsize=7, ha="center")
    axes.text(start + 1000 * _RULER, line + 5, f"{1000 * _RULER:.0f} mm", fontsize=7, ha="center")
    words = (
        f"ChArUco {columns} x {rows}, {board.dictionary}, marker {board.marker:g} of a square. Square: "
        f"{1000 * board.square:.2f} mm if this ruler is {1000 * _RULER:.0f} mm long.\n"
        "Print at 100 %, without 'fit to page'. Measure the ruler and the board's width on the print, and give the "
        "true side of a square as board.square [m]."
    )
    axes.text(start, 1000 * _MARGIN, words, fontsize=6, va="bottom", linespacing=1.3)
    return figure


def find_board(image: np.ndarray, board: BoardConfig) -> Detection:
    """Detect corners of the board in a picture, (H, W, 3) RGB or (H, W), uint8, with sub-pixel accuracy."""
    cv2 = opencv()
    grey = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY) if image.ndim == 3 else image
    parameters = cv2.aruco.DetectorParameters()
    parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
    printed = cv2.aruco.CharucoBoard(
        board.squares, board.square, board.square * board.marker, _dictionary(board)
    )
    detector = cv2.aruco.CharucoDetector(printed, cv2.aruco.CharucoParameters(), parameters)
    corners, ids, _, _ = detector.detectBoard(np.ascontiguousarray(grey))
    if ids is None or len(ids) == 0:
        return Detection(np.empty(0, np.int64), np.empty((0, 2)))
    return _refined(grey, ids.ravel().astype(np.int64), corners.reshape(-1, 2), board)


def _refined(grey: np.ndarray, ids: np.ndarray, corners: np.ndarray, board: BoardConfig) -> Detection:
    """Refine detected corners and drop those that disagree with the homography of their neighbours.

    The detector leaves some corners unrefined, and its versions differ by half a pixel. The search window excludes the
    markers. Over a few squares, a homography absorbs most of the lens distortion.
    """
    cv2 = opencv()
    places = np.stack(np.divmod(ids, board.squares[0] - 1), axis=1)
    distances = np.abs(places[:, None] - places[None]).sum(axis=2)
    refined, sides = corners.astype(np.float32), np.zeros(len(ids))
    for i, corner in enumerate(corners):
        near = distances[i] == 1
        if near.any():
            sides[i] = np.linalg.norm(corners[near] - corner, axis=1).min()
            window = int(np.clip(sides[i] * (1 - board.marker) / 2, 2, 10))
            start = corner.reshape(1, 1, 2).astype(np.float32)
            refined[i] = cv2.cornerSubPix(grey, start, (window, window), (-1, -1), (3, 50, 1e-3)).ravel()
    kept = []
    for i in range(len(ids) if len(ids) >= _MIN_CORNERS else 0):
        others = np.argsort(distances[i], kind="stable")[1:NEIGHBOURS]
        homography, _ = cv2.findHomography(places[others].astype(np.float32), refined[others], cv2.LMEDS)
        if homography is None:
            continue
        predicted = homography @ [*places[i], 1.0]
        distance = np.linalg.norm(refined[i] - predicted[:2] / predicted[2])
        if sides[i] > 0 and distance < NEIGHBOUR_TOLERANCE[0] + NEIGHBOUR_TOLERANCE[1] * sides[i]:
            kept.append(i)
    return Detection(ids[kept], refined[kept].astype(np.float64) + HALF_PIXEL)


def board_pose(detection: Detection, board: BoardConfig, lens: Lens, where: str) -> tuple[np.ndarray, float]:
    """Pose of one camera from the board alone.

    Args:
        detection: the corners in its picture.
        where: name of the picture for messages.

    Returns:
        Transform from the board's frame to the camera (4, 4), and root-mean-square reprojection error [px].

    Raises:
        InputError: too few corners, or they do not fit a flat board seen from above.
    """
    cv2 = opencv()
    points = corner_positions(board)[detection.ids]
    if len(points) < _MIN_CORNERS or np.linalg.matrix_rank(points - points.mean(axis=0), 1e-9) < 2:
        raise InputError(
            where,
            f"{len(points)} corners of the board are detected, {_MIN_CORNERS} in two rows are required",
            "Check that the board is the one of capture.yaml, in focus and without glare",
        )
    seen = lens.directions(detection.pixels)
    flat = points.reshape(-1, 1, 3), seen.reshape(-1, 1, 2), np.eye(3), None
    _, rotations, shifts, _ = cv2.solvePnPGeneric(*flat, flags=cv2.SOLVEPNP_IPPE)
    best = None
    for rotation, shift in zip(rotations, shifts):  # a planar target has two solutions
        rotation, shift = cv2.solvePnPRefineLM(*flat, rotation, shift)
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = cv2.Rodrigues(rotation)[0], shift.ravel()
        error = _pixel_error(pose, points, detection.pixels, lens)
        from_above = (pose[:3, :3].T @ pose[:3, 3])[2] < 0
        if from_above and (best is None or error < best[1]):
            best = pose, error
    if best is None or not best[1] < _MAX_PIXELS:
        error = f" (error {best[1]:.1f} px, limit {_MAX_PIXELS:g} px)" if best else ""
        problem = f"the corners do not fit a flat board seen from above{error}"
        raise InputError(where, problem, "Check board.squares, the lens, and that the print lies flat")
    return best


def _pixel_error(pose: np.ndarray, points: np.ndarray, pixels: np.ndarray, lens: Lens) -> float:
    seen = points @ pose[:3, :3].T + pose[:3, 3]
    if (seen[:, 2] <= 0).any():
        return np.inf
    return float(np.sqrt(((lens.project(seen) - pixels) ** 2).sum(axis=1).mean()))


def fit_board(
    detections: Sequence[Detection], lenses: Sequence[Lens], viewmats: np.ndarray, board: BoardConfig
) -> BoardFit:
    """Fit the similarity from a reconstruction to the board's frame, from its corners in many pictures.

    Args:
        detections: corners in each of N pictures, possibly empty.
        lenses: of each picture.
        viewmats: world to camera, (N, 4, 4).

    Raises:
        InputError: the board is visible in too few pictures, or its corners do not lie as printed.
    """
    seen: dict[int, list[tuple[int, np.ndarray]]] = {}
    for picture, (corners, lens) in enumerate(zip(detections, lenses)):
        if len(corners.ids):
            for number, direction in zip(corners.ids, lens.directions(corners.pixels)):
                seen.setdefault(int(number), []).append((picture, direction))
    pictures = sum(len(corners.ids) > 0 for corners in detections)
    numbers, points = [], []
    for number, views in sorted(seen.items()):
        if len(views) < 2:
            continue
        index = [picture for picture, _ in views]
        point, angle = triangulate(viewmats[index], np.stack([direction for _, direction in views]))
        if angle > MIN_ANGLE and np.isfinite(point).all():
            numbers.append(number)
            points.append(point)
    printed = corner_positions(board)[numbers] if numbers else np.empty((0, 3))
    if len(numbers) < _MIN_CORNERS or np.linalg.matrix_rank(printed - printed.mean(axis=0), 1e-9) < 2:
        raise InputError(
            "board",
            f"it is visible in {pictures} of {len(detections)} pictures, and {len(numbers)} of its corners from two"
            f" sides, {_MIN_CORNERS} in two rows are required",
            "Photograph the uncovered board with the object from all sides, or set `length` instead",
        )
    world = np.stack(points)
    placed = fit_similarity(world, printed)
    residuals = placed.apply(world) - printed
    residual = float(np.sqrt((residuals**2).sum(axis=1).mean()))
    flatness = float(np.sqrt((residuals[:, 2] ** 2).mean()))
    fit = BoardFit(placed, np.array(numbers), residual, flatness, pictures)
    if fit.residual > MAX_MISFIT * board.square:
        raise InputError(
            "board.squares",
            f"the corners deviate from the print by {1000 * fit.residual:.1f} mm (root mean square), the limit is"
            f" {1000 * MAX_MISFIT * board.square:.1f} mm",
            "Check that the board was not moved or bent between the photographs, and that board.squares is as printed",
        )
    return fit


def room_from_board(board: BoardConfig, center: tuple[float, float] | None) -> Similarity:
    """From the board's frame to the room: y up, floor at y = 0, origin below ``center`` (None: middle of the board)."""
    columns, rows = board.squares
    x, y = center or (board.square * columns / 2, board.square * rows / 2)
    return Similarity(1.0, Y_UP, -Y_UP @ [x, y, -board.thickness])


def board_outline(
    board: BoardConfig, center: tuple[float, float] | None, viewmat: np.ndarray, K: np.ndarray
) -> np.ndarray | None:
    """Corners (4, 2) [px] of the printed board with a margin of a square in a pinhole camera, in order.

    ``viewmat`` (4, 4) is from the room's metres to the camera, OpenCV axes. None if the board is behind the camera.
    """
    columns, rows = board.squares
    ends = [(-1, -1), (columns + 1, -1), (columns + 1, rows + 1), (-1, rows + 1)]
    corners = np.array([(x * board.square, y * board.square, 0.0) for x, y in ends])
    corners = room_from_board(board, center).apply(corners)
    depths = corners @ viewmat[2, :3] + viewmat[2, 3]
    return project(corners, viewmat, K) if (depths > 0).all() else None


def _dictionary(board: BoardConfig):
    cv2 = opencv()
    return cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, board.dictionary))
