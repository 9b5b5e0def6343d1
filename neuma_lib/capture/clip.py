"""What one video of a launched object shows without photographs, board or calibration.

The camera is assumed to be fixed and level and to look across the flight. Metres come from the known width of the
object in the pictures in which it is slowest, or from gravity if its width is unknown. Gravity checks the frame rate,
the width and the level of the camera together. The silhouettes show whether the object may be a body of revolution. A
ball that rebounds shows its stiffness, or a lower bound of it. Other constants need photographs (docs/capture.md).
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
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
from neuma_lib.capture.masks.regions import centroid, overlay, radius_of, whole
from neuma_lib.capture.masks.revolution import Revolution, fit_revolution
from neuma_lib.capture.masks.video_masks import find_flight_window, video_masks
from neuma_lib.capture.motion.bounce import MIN_RADIUS, Rise, ends, measure_bounce
from neuma_lib.capture.motion.free_fall import FreeFall, Track, fit_flight
from neuma_lib.capture.motion.spin import Spin, fit_spin, follow
from neuma_lib.capture.pictures import evidence, picture_sheet
from neuma_lib.capture.report.page import Check, gravity_checks, markdown
from neuma_lib.capture.tools import new_figure, opencv, save_figure
from neuma_lib.config.simulation import GRAVITY
from neuma_lib.errors import InputError
from neuma_lib.io.files import write_json, write_text
from neuma_lib.io.mesh import write_mesh

_LONGEST = 1000  # side of the pictures [px]
_DURATION = 2.0  # from the start of the first flight [s]
_BACKGROUND_FRAMES = 61
_CONSTANTS = (  # of a ball: key of the report, name, limit, factor and unit on the page
    ("restitution_band", "restitution", 1.0, 1.0, ""),
    ("contact_s_band", "duration of contact", None, 1e3, " ms"),
    ("flattening_of_radius_band", "flattening of the radius, by Hertz,", 0.2, 1.0, ""),
    ("modulus_per_density_m2_s2_band", "E / (1 - nu^2) for 1000 kg/m^3", None, 1e-3, " MPa"),
)
_SHAPE_FRAMES = 40  # at most, from which the shape is measured
_FOCAL = 1.2  # focal length relative to the picture's width; it nearly cancels for a flight across the view
_PLANE = (np.zeros(3), np.array([0.0, 0.0, 1.0]))


@dataclass(frozen=True, eq=False)
class ClipFlight:
    """One free flight in a clip."""

    frames: tuple[int, int]  # numbers of the first and last frame of the fit
    used: np.ndarray  # indices of its frames among the masks, (T,)
    times: np.ndarray  # of the fit [s], (T,)
    places: np.ndarray  # positions of the centre [px], (T, 2)
    width: tuple[float, float]  # of the object across its longer axis [px], and its standard deviation
    fall: FreeFall  # in metres, y up, x to the right, in the plane z = 0
    spin: Spin | None  # None if the object has too little texture

    def rise(self, diameter: float | None) -> Rise:
        """The height of the centre [px], upward from the top of the picture."""
        scale = (diameter or 1.0) / self.width[0]
        mean = np.array([self.fall.x0[1], self.fall.v0[1], self.fall.a[1]]) / scale
        mean[0] -= np.mean(self.places[:, 1] + self.fall.place(self.times)[:, 1] / scale)
        return Rise(self.fall.start, mean, self.fall.covariance[1:9:3, 1:9:3] / scale**2)

    def report(self, diameter: float | None) -> dict[str, Any]:
        """JSON report. Without a known diameter, lengths are in diameters of an object that falls with gravity."""
        ratio, deviation = self.fall.gravity.ratio
        size = self.width[1] / self.width[0]
        implied = None if diameter else [1 / ratio, float(np.hypot(deviation / ratio, size) / ratio)]
        return {
            "frames": list(self.frames),
            "width_px": self.width[0],
            "pixel_m": (diameter or 1 / ratio) / self.width[0],
            "pixel_deviation": size if diameter else deviation / ratio,
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
        if masks is None:
            sheet = frames
        else:
            sheet = [overlay(f, masks[np.searchsorted(window, f.number)]) for f in frames]
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
    used = window[result.masks.any(axis=(1, 2))]
    report: dict[str, Any] = {
        "frames": len(timeline.times),
        "rate": timeline.rate,
        "repeated": timeline.repeated.tolist(),
        "camera_shift": shift,
        "used": [int(used[0]), int(used[-1])],
        "left_out": [each.plain() for each in breaks],
        "flights": [flight.report(diameter) for flight in flights],
        "rebounds": [_rebound(*pair) for pair in pairwise(flights)],
    }
    _draw_flights(folder / "flights.png", flights, background, video.name)
    pages = {"Masks": "masks.png", "Flights": "flights.png"}
    best = min(report["flights"], key=lambda flight: flight["pixel_deviation"])
    shape = _shape(flights, result.masks)
    report["shape"] = _shape_report(shape, best["pixel_m"], folder) if shape else None
    if shape:
        pages["Shape: silhouettes grey and blue, body of revolution grey and red"] = "shape.png"
    for k, (pair, rebound) in enumerate(zip(pairwise(flights), report["rebounds"]), start=1):
        rises = [flight.rise(diameter) for flight in pair]
        parts = rises, [flight.used for flight in pair], result.masks, times
        if shape and shape.report["ball"]:
            rebound["ball"] = measure_bounce(*parts, best["pixel_m"], best["pixel_deviation"])
        if rebound["ball"]:
            pages[f"Rebound {k}: ends of the silhouettes, free flights and floor"] = f"rebound_{k}.png"
            _draw_rebound(folder / f"rebound_{k}.png", rebound["ball"], *parts)
    write_json(folder / "clip.json", report)
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
    return ClipFlight(frames, used, times[used], places[kept], width, fall, fit_spin(paths, [track], fall))


def _width(masks: np.ndarray, places: np.ndarray) -> tuple[float, float]:
    """Width of the masks across their longer axis where the object is slowest, and its standard deviation [px]."""
    speeds = np.linalg.norm(np.gradient(places, axis=0), axis=1)
    slowest = np.argsort(speeds)[: max(3, len(speeds) // 4)]
    # An ellipse with half an axis r has the variance r^2 / 4 along it.
    widths = [4 * np.sqrt(np.linalg.eigvalsh(np.cov(np.argwhere(masks[i]).T))[0]) for i in slowest]
    return float(np.median(widths)), float(np.std(widths) / np.sqrt(len(widths)))


def _shape(flights: Sequence[ClipFlight], masks: np.ndarray) -> Revolution | None:
    """Body of revolution of the slower, less blurred half of the frames. None if too few or too small."""
    frames = np.concatenate([flight.used for flight in flights])
    velocities = np.concatenate([np.gradient(f.places, f.times, axis=0) for f in flights])
    speeds = np.linalg.norm(velocities, axis=1)
    large = np.array([whole(masks[k]) and radius_of(masks[k]) >= MIN_RADIUS for k in frames])
    chosen = np.flatnonzero(large & (speeds <= np.median(speeds)))
    if len(chosen) < 3:
        return None
    chosen = chosen[:: -(-len(chosen) // _SHAPE_FRAMES)]
    return fit_revolution(masks[frames[chosen]], velocities[chosen])


def _shape_report(shape: Revolution, pixel: float, folder: Path) -> dict[str, Any]:
    """JSON report of a shape for a length of a pixel [m]. Writes ``shape.png`` and ``shape.ply``."""
    palette = np.array([(255, 255, 255), (60, 110, 220), (220, 40, 40), (170, 170, 170)], np.uint8)
    some = np.linspace(0, len(shape.pairs) - 1, min(12, len(shape.pairs))).astype(int)
    pictures = [
        (f"{shape.deviations[k]:.1f} px", palette[shape.pairs[k, 0] + 2 * shape.pairs[k, 1]]) for k in some
    ]
    picture_sheet(folder / "shape.png", pictures, "silhouettes with the axis vertical", 6)
    mesh = shape.mesh.apply_scale(pixel)
    if shape.report["agrees"]:
        write_mesh(folder / "shape.ply", mesh.vertices, mesh.faces)
    wide, _, length = np.ptp(mesh.vertices, axis=0).tolist()
    # Edges are wrong by the tolerated distance on both sides, for example where a mask lacks the dark side.
    sizes = {"diameter_m": wide, "length_m": length, "tolerance_m": 2 * shape.report["limit_px"] * pixel}
    return shape.report | sizes | {"volume_m3": float(mesh.volume)}


def _rebound(before: ClipFlight, after: ClipFlight) -> dict[str, Any]:
    """Velocities at the end of a flight and the start of the next, and their ratio normal to a level floor."""
    ahead, behind = before.times[-1] - before.fall.start, after.times[0] - after.fall.start
    down, up = before.fall.v0 + before.fall.a * ahead, after.fall.v0 + after.fall.a * behind
    return {
        "between_s": float(after.times[0] - before.times[-1]),
        "restitution": float(-up[1] / down[1]) if down[1] < 0 else None,
        "along_floor": float(up[0] / down[0]) if down[0] else None,
        "ball": None,
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
        result += _rebound_checks(report["rebounds"][k - 1], name) if k else []
    if shape := report["shape"]:
        wide, length, tolerance = (1e3 * shape[key] for key in ("diameter_m", "length_m", "tolerance_m"))
        text = f"{wide:.1f} mm wide, {length:.1f} mm along the axis, +- {tolerance:.1f} mm"
        if shape["blur_px"] > 2 * shape["limit_px"]:
            text = f"none, since it is {shape['blur_px']:.0f} px longer along its motion, as by blur"
        elif not shape["agrees"]:
            text = "none, the object is not one, or its masks are wrong"
        elif shape["ball"]:
            text = f"a ball, {text}"
        elif shape["other_axis_px"] <= shape["limit_px"]:
            text += ", or the axis is another one"
        text += f", silhouettes differ by up to {shape['deviation_px']:.1f} px"
        result.append(Check("shape of revolution", text, f"< {shape['limit_px']:.1f} px", shape["agrees"]))
    return result


def _rebound_checks(rebound: dict[str, Any], name: str) -> list[Check]:
    if not (ball := rebound["ball"]):
        ratio = rebound["restitution"]
        text, good = f"{ratio or 0:.2f}", 0 < (ratio or 0) < 1
        return [] if ratio is None else [Check(f"restitution before {name}", text, "0 to 1", good)]
    result = []
    for key, what, limit, factor, unit in _CONSTANTS:
        low, middle, high = (value and factor * value for value in ball[key])
        text = f"> {low:.3g}" if low else f"< {high or 0:.3g}"
        text = f"{middle:.3g} ({low:.3g} to {high:.3g})" if middle else text
        good = limit is None or (low or 0.0) < limit
        result.append(Check(f"{what} before {name}", text + unit, f"< {limit}" if limit else "", good))
    if largest := ball["largest_flattening_seen_m"]:
        text = f"{1e3 * largest:.1f} mm in {ball['frames_of_contact']} frames of contact"
        result.append(Check(f"largest visible flattening before {name}", text, "", True))
    return result


def _draw_rebound(path: Path, ball: dict[str, Any], rises: list[Rise], flying: list, masks, times) -> None:
    frames = [k for k in range(flying[0][-5:][0], flying[1][:5][-1] + 1) if masks[k].any()]
    heights = np.array([ends(masks[k]) for k in frames]) - ball["floor_px"]
    t = np.linspace(times[frames[0]], times[frames[-1]], 200)
    figure = new_figure(9, 5)
    axes = figure.subplots()
    axes.plot(1e3 * times[frames], heights, "o", label=["lowest point", "highest point"])
    for rise in rises:
        axes.plot(1e3 * t, rise.state(t)[0] - ball["radius_px"] - ball["floor_px"], "k-", lw=1)
    axes.axhline(0.0, color="tab:brown")
    axes.set(xlabel="time [ms]", ylabel="height above the lowest silhouette [px]")
    axes.set_ylim(heights.min() - ball["radius_px"], heights.max() + 5)
    axes.legend()
    save_figure(path, figure)


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
