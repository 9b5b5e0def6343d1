"""What one video of a launched object shows without photographs, board or calibration.

The camera is assumed to be fixed and level and to look across the flight. Metres come from the known width of the
object in the pictures in which it is slowest, or from gravity if its width is unknown. Gravity checks the frame rate,
the width and the level of the camera together. Stiffness and yield stress need the shape of the object, that is
photographs (docs/capture.md).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from neuma_lib.capture.frames import (
    Frame,
    StoredPictures,
    Timeline,
    contact_sheet,
    read_frames,
    read_timeline,
    sheet_numbers,
)
from neuma_lib.capture.masks.background import median_background
from neuma_lib.capture.masks.camera_motion import background_shift, check_fixed
from neuma_lib.capture.masks.continuity import Break
from neuma_lib.capture.masks.regions import centroid, overlay
from neuma_lib.capture.masks.video_masks import find_flight_window, video_masks
from neuma_lib.capture.motion.free_fall import FreeFall, Track, fit_flight
from neuma_lib.capture.motion.spin import Spin, fit_spin, follow
from neuma_lib.capture.pictures import evidence
from neuma_lib.capture.report.page import Check, gravity_checks, markdown
from neuma_lib.capture.tools import new_figure, opencv, save_figure
from neuma_lib.config.simulation import GRAVITY
from neuma_lib.errors import InputError
from neuma_lib.io.files import write_json, write_text

_LONGEST = 1000  # side of the pictures [px]
_DURATION = 2.0  # from the start of the first flight [s]
_BACKGROUND_FRAMES = 61
_FOCAL = 1.2  # focal length relative to the picture's width; it nearly cancels for a flight across the view
_PLANE = (np.zeros(3), np.array([0.0, 0.0, 1.0]))


@dataclass(frozen=True, eq=False)
class ClipFlight:
    """One free flight in a clip."""

    frames: tuple[int, int]  # numbers of the first and last frame of the fit
    times: np.ndarray  # of the fit [s], (T,)
    places: np.ndarray  # positions of the centre [px], (T, 2)
    width: tuple[float, float]  # of the object across its longer axis [px], and its standard deviation
    fall: FreeFall  # in metres, y up, x to the right, in the plane z = 0
    spin: Spin | None  # None if the object has too little texture

    def report(self, diameter: float | None) -> dict[str, Any]:
        """JSON report. Without a known diameter, lengths are in diameters of an object that falls with gravity."""
        ratio, deviation = self.fall.gravity.ratio
        size = self.width[1] / self.width[0]
        implied = None if diameter else [1 / ratio, float(np.hypot(deviation / ratio, size) / ratio)]
        return {
            "frames": list(self.frames),
            "width_px": self.width[0],
            **self.fall.gravity.report(),
            "gravity_ratio_deviation": float(np.hypot(deviation, ratio * size)) if diameter else deviation,
            "diameter_m": diameter or implied[0],
            "diameter_deviation_m": None if diameter else implied[1],
            "speed_m_s": float(np.linalg.norm(self.fall.v0)) * (1.0 if diameter else 1 / ratio),
            "spin_rad_s": self.spin.velocity.tolist() if self.spin else None,
            "spin_deviation_rad_s": np.sqrt(np.diag(self.spin.covariance)).tolist() if self.spin else None,
            "rms_px": self.fall.rms,
        }


def analyse_clip(video: str | Path, folder: str | Path, diameter: float | None = None) -> dict[str, Any]:
    """Measure the flights in a video, and write ``clip.md``, ``clip.json`` and pictures to a folder.

    Args:
        video: of a fixed camera.
        folder: of the results.
        diameter: width of the object across its longer axis [m]. None: it follows from gravity.

    Returns:
        The content of ``clip.json``.

    Raises:
        InputError: the camera moves, the object is not detected, or there is no free flight.
    """
    video, folder = Path(video), Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    timeline = read_timeline(video)
    background, shift = _background(video, timeline, folder)
    numbers = timeline.numbers
    small = _resized(background, 500)
    window = numbers[
        find_flight_window(
            (_resized(f.pixels, 500) for f in read_frames(video, timeline)),
            small,
            timeline.times[numbers],
            _DURATION,
            np.array([0.0, 1.0]),
        )
    ]
    pictures = StoredPictures(_resized(f.pixels) for f in read_frames(video, timeline, window))
    times = timeline.times[window]

    def draw(path: Path, masks: np.ndarray | None = None, text: str = "") -> None:
        used = np.arange(len(window)) if masks is None else np.flatnonzero(masks.any(axis=(1, 2)))
        frames = [Frame(int(window[k]), float(times[k]), pictures[k]) for k in used[sheet_numbers(len(used))]]
        sheet = (
            frames
            if masks is None
            else [overlay(f, masks[np.searchsorted(window, f.number)]) for f in frames]
        )
        contact_sheet(path, sheet, f"{video.name}{text}")

    with evidence(folder / "masks.png", draw):
        result = video_masks(pictures, video, background, times, down=np.array([0.0, 1.0]))
        if not result.tracks:
            problem = "no free flight detected: 5 frames or more in which the object moves along a parabola"
            raise InputError(
                video, problem, "Film the whole flight, from the side, at 60 frames per second or more"
            )
    draw(folder / "masks.png", result.masks)
    flights = []
    for track in result.tracks:
        chosen = np.arange(track.frames[0], track.frames[1] + 1)
        chosen = chosen[result.masks[chosen].any(axis=(1, 2))]
        flights.append(_flight(pictures, result.masks, window, times, chosen, diameter, video.name))
    breaks = [b._replace(first=int(window[b.first]), last=int(window[b.last])) for b in result.breaks]
    report = _report(timeline, flights, breaks, shift, result.masks, window, diameter)
    _draw_flights(folder / "flights.png", flights, background, video.name)
    write_json(folder / "clip.json", report)
    pages = {"Masks": "masks.png", "Flights": "flights.png"}
    write_text(folder / "clip.md", markdown(f"{video.name}: free flight", checks(report), pages))
    return report


def _resized(picture: np.ndarray, longest: int = _LONGEST) -> np.ndarray:
    height, width = picture.shape[:2]
    factor = min(1.0, longest / max(height, width))
    size = (round(factor * width), round(factor * height))
    return picture if factor == 1 else opencv().resize(picture, size, interpolation=opencv().INTER_AREA)


def _background(video: Path, timeline: Timeline, folder: Path) -> tuple[np.ndarray, float]:
    """Median of frames, and the largest shift of a frame from it as share of the picture."""
    chosen = timeline.numbers[sheet_numbers(len(timeline.numbers), _BACKGROUND_FRAMES)]
    frames = [f._replace(pixels=_resized(f.pixels)) for f in read_frames(video, timeline, chosen)]
    background = median_background([frame.pixels for frame in frames])
    some = frames[:: max(1, len(frames) // 20)]
    shifts = [background_shift(frames[0].pixels, frame.pixels) for frame in some]
    with evidence(folder / "masks.png", lambda path: contact_sheet(path, some, video.name)):
        return background, check_fixed(shifts, [f.number for f in some], max(background.shape), video)


def _flight(
    pictures: Sequence[np.ndarray],
    masks: np.ndarray,
    window: np.ndarray,
    times: np.ndarray,
    chosen: np.ndarray,
    diameter: float | None,
    name: str,
) -> ClipFlight:
    places = np.array([centroid(masks[k]) for k in chosen])
    width = _width(masks[chosen], places)
    height, across = masks.shape[1:]
    focal = _FOCAL * across
    viewmat = np.diag([1.0, -1.0, -1.0, 1.0])
    viewmat[2, 3] = focal * (diameter or 1.0) / width[0]
    K = np.array([[focal, 0, across / 2], [0, focal, height / 2], [0, 0, 1.0]])
    track = Track(times[chosen], places, viewmat, K, name, width[0] / 2)
    fall, (kept,) = fit_flight([track], _PLANE)
    used = chosen[kept]
    paths = follow([pictures[k] for k in used], masks[used], times[used], 0)
    frames = (int(window[used[0]]), int(window[used[-1]]))
    return ClipFlight(frames, times[used], places[kept], width, fall, fit_spin(paths, [track], fall))


def _width(masks: np.ndarray, places: np.ndarray) -> tuple[float, float]:
    """Width of the masks across their longer axis where the object is slowest, and its standard deviation [px]."""
    speeds = np.linalg.norm(np.gradient(places, axis=0), axis=1)
    slowest = np.argsort(speeds)[: max(3, len(speeds) // 4)]
    # An ellipse with half an axis r has the variance r^2 / 4 along it.
    widths = [4 * np.sqrt(np.linalg.eigvalsh(np.cov(np.argwhere(masks[i]).T))[0]) for i in slowest]
    return float(np.median(widths)), float(np.std(widths) / np.sqrt(len(widths)))


def _report(
    timeline: Timeline,
    flights: Sequence[ClipFlight],
    breaks: Sequence[Break],
    shift: float,
    masks: np.ndarray,
    window: np.ndarray,
    diameter: float | None,
) -> dict[str, Any]:
    used = window[masks.any(axis=(1, 2))]
    return {
        "frames": len(timeline.times),
        "rate": timeline.rate,
        "repeated": timeline.repeated.tolist(),
        "camera_shift": shift,
        "used": [int(used[0]), int(used[-1])],
        "left_out": [each.plain() for each in breaks],
        "flights": [flight.report(diameter) for flight in flights],
        "rebounds": [_rebound(a, b) for a, b in zip(flights, flights[1:])],
    }


def _rebound(before: ClipFlight, after: ClipFlight) -> dict[str, Any]:
    """Velocities at the end of a flight and the start of the next, and their ratio normal to a level floor."""
    ahead, behind = before.times[-1] - before.fall.start, after.times[0] - after.fall.start
    down, up = before.fall.v0 + before.fall.a * ahead, after.fall.v0 + after.fall.a * behind
    return {
        "between_s": float(after.times[0] - before.times[-1]),
        "restitution": float(-up[1] / down[1]) if down[1] < 0 else None,
        "along_floor": float(up[0] / down[0]) if down[0] else None,
    }


def checks(report: dict[str, Any]) -> list[Check]:
    """Measured quantities of a report of `analyse_clip`, with their expected values."""
    repeated = len(report["repeated"])
    text = f"{report['frames']} at {report['rate']:.2f} a second"
    result = [Check("frames", text + (f", {repeated} repeated ones left out" if repeated else ""), "", True)]
    if report["left_out"]:
        text = "; ".join(str(Break(**each)) for each in report["left_out"])
        result.append(Check("frames left out", text, "none", False))
    for k, flight in enumerate(report["flights"]):
        name = f"frames {flight['frames'][0]} to {flight['frames'][1]}"
        size, angle = gravity_checks(name, flight)
        if flight["diameter_deviation_m"] is None:
            result.append(size)
        else:
            text = f"{1e3 * flight['diameter_m']:.1f} +- {1e3 * flight['diameter_deviation_m']:.1f} mm"
            result.append(
                Check(f"width, if gravity is {GRAVITY} m/s^2, {name}", text, "the measured one", True)
            )
        result.append(angle)
        if spin := flight["spin_rad_s"]:
            size, deviation = np.linalg.norm(spin), np.linalg.norm(flight["spin_deviation_rad_s"])
            result.append(Check(f"spin in {name}", f"{size:.1f} +- {deviation:.1f} rad/s", "", True))
        if k and (restitution := report["rebounds"][k - 1]["restitution"]) is not None:
            good = 0 < restitution < 1
            result.append(Check(f"restitution before {name}", f"{restitution:.2f}", "0 to 1", good))
    return result


def _draw_flights(path: Path, flights: Sequence[ClipFlight], background: np.ndarray, title: str) -> None:
    figure = new_figure(10, 6)
    axes = figure.subplots()
    axes.imshow(background // 2 + 127)
    for flight in flights:
        first, last = flight.frames
        axes.plot(*flight.places.T, ".", label=f"frames {first} to {last}")
    axes.set(title=title, xlabel="x [px]", ylabel="y [px]")
    axes.legend()
    save_figure(path, figure)
