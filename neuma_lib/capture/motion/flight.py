"""Free flight of one take, from the masks of all its cameras: time offsets, gravity, velocity and spin."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from neuma_lib.capture.calibration.vertical import Cue, check_vertical
from neuma_lib.capture.masks.agreement import agreement
from neuma_lib.capture.masks.regions import centroid
from neuma_lib.capture.motion.contact import contact_time, lowest_points, place_on_floor
from neuma_lib.capture.motion.free_fall import AT_CONTACT, FreeFall, Track, fit_flight
from neuma_lib.capture.motion.spin import Spin, fit_spin, follow
from neuma_lib.capture.motion.timing import (
    Offset,
    choose_offset,
    offset_from_motion,
    offset_from_sound,
    row_times,
)
from neuma_lib.capture.tools import new_figure, save_figure
from neuma_lib.errors import InputError

TOLERATED_DEVIATIONS = 2.0
"""Standard deviations by which gravity from masks must exceed its limit to be refused.

The centroid of a mask is not the centre of mass. Registration measures gravity again, for the placed object, without
this tolerance."""
_AFTER = 4  # frames after the flight that are searched for the contact
_MIN_SIDEWAYS = 0.05  # least velocity along the view, as share of the velocity


@dataclass(frozen=True, eq=False)
class Filmed:
    """Undistorted frames of a take by one camera, those with a mask."""

    camera: str  # its name
    numbers: np.ndarray  # of the frames, (T,)
    times: np.ndarray  # on its clock [s], (T,)
    pixels: Sequence[np.ndarray]  # T pictures, RGB or RGBA, (H, W, 3) or (H, W, 4), uint8
    masks: np.ndarray  # (T, H, W)
    # numbers of the first and last frame of its first free flight. None without free flight.
    flight: tuple[int, int] | None
    # viewmat, K: in the room, (4, 4) and (3, 3)
    viewmat: np.ndarray
    K: np.ndarray
    sensor_rows: int  # rows of the recorded frames
    row_time: float = 0.0  # of a rolling shutter [s]
    sound: np.ndarray | None = None  # mono, (N,). None if missing or not on the clock of the picture.
    offset: float | None = None  # set by the user [s]. None if it is to be estimated.

    @property
    def centroids(self) -> np.ndarray:
        """(T, 2) [px]."""
        return np.array([centroid(mask) for mask in self.masks])

    @property
    def row_times(self) -> np.ndarray:
        """Read-out times of the row of the object's centre, (T,) [s]."""
        rows = self.centroids[:, 1]
        return row_times(self.times, rows, self.row_time, self.masks.shape[1], self.sensor_rows)

    @property
    def row_delay(self) -> float:
        """Upper bound of the time between the read-out of opposite edges of the object [s].

        A rolling shutter reads a frame in less than the time between two frames, along the height, or the width if the
        phone was turned. 0 if its row time is set.
        """
        if self.row_time:
            return 0.0
        shares = [np.median(self.masks.any(axis=axis).mean(axis=1)) for axis in (1, 2)]
        return float(np.median(np.diff(self.times)) * max(shares))


@dataclass(frozen=True, eq=False)
class Flight:
    """Free flight of a take."""

    fall: FreeFall  # in the room
    spin: Spin | None  # None if the object has too little texture
    frames: list[tuple[int, int]]  # numbers of the first and last frame of the fit, for each camera
    tracks: list[Track]  # of the cameras, all frames
    offsets_from: list[str]  # source of the time offset of each camera but the first, as text
    # IoU of each camera's mask at rest with the common body. None with one camera.
    agreement: np.ndarray | None
    gravity: str  # result of the gravity check, as text


def find_flight(views: Sequence[Filmed], name: str, metric: bool = True, cues: Sequence[Cue] = ()) -> Flight:
    """Fit the free flight of a take.

    A single camera requires a plane: the vertical one that faces the camera, through the place where the object
    touches the floor, or through the middle of the room if the video does not show that.

    Args:
        views: of the cameras. The first one is the time reference.
        name: of the take for messages.
        metric: whether the room's lengths are metres, so that gravity is checked.
        cues: upward directions in the room, compared with gravity.

    Raises:
        InputError: a camera shows no free flight, the time between two cameras is undetermined, no flight fits,
            gravity is significantly off by more than 10 %, or its direction contradicts the cues.
    """
    tracks, inside = [], []
    for view in views:
        if view.flight is None:
            raise InputError(
                f"{name}, {view.camera}",
                "no free flight detected: 5 frames or more in which the object moves along a parabola by its size",
                "Film the whole fall from 0.3 m at 60 frames per second or more, and check the masks' contact sheet",
            )
        flying = (view.numbers >= view.flight[0]) & (view.numbers <= view.flight[1])
        inside.append(np.flatnonzero(flying))
        times, places = view.row_times[flying], view.centroids[flying]
        radius = float(np.sqrt(np.median(view.masks[flying].sum(axis=(1, 2))) / np.pi))
        tracks.append(Track(times, places, view.viewmat, view.K, f"{name}, {view.camera}", radius))
    offsets, lines = [0.0], []
    for view in views[1:]:
        offset, line = _offset(views[0], view, f"{name}, {view.camera}")
        offsets.append(offset)
        lines.append(line)
    fixed = [view.offset is not None for view in views]
    touched = _touched(views[0], inside[0]) if len(views) == 1 else None
    plane = _plane(views[0], touched[0] if touched else np.zeros(3)) if len(views) == 1 else None
    fall, kept = fit_flight(tracks, plane, offsets, fixed)
    contact = _contact(views, inside, fall)
    if np.isfinite(contact):
        fall, kept = fit_flight(tracks, plane, fall.offsets, fixed, contact)
    if touched:
        used = tracks[0].times[kept[0]]
        fall = replace(fall, views=AT_CONTACT, distance=_distance_error(fall, views[0], used, touched[1]))
    if cues:
        check_vertical([*cues, fall.gravity.cue], name)
    gravity = (
        fall.gravity.check(name, tolerated=TOLERATED_DEVIATIONS) if metric else fall.gravity.describe(name)
    )
    frames, paths = [], []
    for number, (view, flying, part) in enumerate(zip(views, inside, kept)):
        used = flying[part]
        frames.append((int(view.numbers[used[0]]), int(view.numbers[used[-1]])))
        paths += follow(
            [view.pixels[i][..., :3] for i in used], view.masks[used], view.row_times[used], number
        )
    spin = fit_spin(paths, tracks, fall)
    return Flight(fall, spin, frames, tracks, lines, _at_rest(views, fall.offsets), gravity)


def _contact(views: Sequence[Filmed], inside: Sequence[np.ndarray], fall: FreeFall) -> float:
    """Contact time on the first camera's clock [s]. Infinite if there is no contact in the given frames."""
    times = [view.row_times[flying] + offset for view, flying, offset in zip(views, inside, fall.offsets)]
    heights = [
        lowest_points(view.masks[flying], fall.place(clock), view.viewmat, view.K)
        for view, flying, clock in zip(views, inside, times)
    ]
    return contact_time(times, heights)


def _offset(first: Filmed, second: Filmed, name: str) -> tuple[float, str]:
    if second.offset is not None:
        return second.offset, f"{name}: time between the cameras from the settings"
    by_sound: Offset | None = None
    if first.sound is not None and second.sound is not None:
        by_sound = offset_from_sound(first.sound, second.sound)
    speeds = [np.linalg.norm(np.gradient(v.centroids, v.times, axis=0), axis=1) for v in (first, second)]
    by_motion = offset_from_motion((first.times, second.times), (speeds[0], speeds[1]))
    best, line = choose_offset(by_sound, by_motion, name)
    return best.seconds, line


def _plane(view: Filmed, point: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The vertical plane through a point that faces the camera: point and normal."""
    eye = -view.viewmat[:3, :3].T @ view.viewmat[:3, 3]
    return point, (eye - point) * (1.0, 0.0, 1.0)


def _touched(view: Filmed, flying: np.ndarray) -> tuple[np.ndarray, float] | None:
    """Centre of the object when it touches the floor, and the relative error of its distance.

    Of the frames around the end of the flight, that in which the object is lowest. None if it is the last one, since
    the object may then be above the floor.
    """
    near = range(flying[-1] - 1, min(flying[-1] + _AFTER, len(view.masks)))
    places = [place_on_floor(view.masks[k], view.viewmat, view.K) for k in near]
    if not places or any(place is None for place in places):
        return None
    eye = -view.viewmat[:3, :3].T @ view.viewmat[:3, 3]
    lowest = int(np.argmin([np.linalg.norm(place[0] - eye) for place in places]))
    return places[lowest] if lowest + 1 < len(places) else None


def _distance_error(fall: FreeFall, view: Filmed, times: np.ndarray, touched: float) -> float:
    """Relative standard deviation of gravity in one view.

    The object may have been above the floor by a quarter of its way between frames. Its velocity along the view is
    unknown and assumed to be like that across the view: motion towards the camera appears as an acceleration of
    2 v u / (d |a|), with the velocity v in the picture at the middle of the flight and u along the view.
    """
    middle = np.array([times.mean()])
    velocity = fall.v0 + fall.a * (middle[0] - fall.start)
    eye = -view.viewmat[:3, :3].T @ view.viewmat[:3, 3]
    away = fall.place(middle)[0] - eye
    distance, flat = float(np.linalg.norm(away)), float(np.hypot(away[0], away[2]))
    last = fall.v0 + fall.a * (times[-1] - fall.start)
    hover = abs(last[1]) * float(np.median(np.diff(times))) / 4 / max(eye[1], 1e-9)
    speed = float(np.linalg.norm(velocity))
    towards = max(float(np.hypot(velocity[0], velocity[2])), _MIN_SIDEWAYS * speed)
    turn = 2 * speed * towards / (distance * float(np.linalg.norm(fall.a)))
    return float(np.sqrt(touched**2 + hover**2 + turn**2 * (flat / distance) ** 2))


def _at_rest(views: Sequence[Filmed], offsets: np.ndarray) -> np.ndarray | None:
    if len(views) == 1:
        return None
    end = min(float(view.times[-1] + offset) for view, offset in zip(views, offsets))
    masks = [view.masks[int(np.abs(view.times + o - end).argmin())] for view, o in zip(views, offsets)]
    return agreement(masks, np.stack([v.viewmat for v in views]), np.stack([v.K for v in views]))


def report(flight: Flight, views: Sequence[Filmed]) -> dict[str, Any]:
    """JSON report of a flight. Metres of the room, y up."""
    fall, spin = flight.fall, flight.spin
    deviations = np.sqrt(np.diag(fall.covariance))
    names = [view.camera for view in views]
    return {
        "start_s": fall.start,
        "x0_m": fall.x0.tolist(),
        "v0_m_s": fall.v0.tolist(),
        "v0_deviation_m_s": deviations[3:6].tolist(),
        **fall.gravity.report(),
        "offsets_s": dict(zip(names, fall.offsets.tolist())),
        "offsets_deviation_s": dict(zip(names, [0.0, *deviations[9:].tolist()])),
        "offsets_from": flight.offsets_from,
        "row_delay_s": {view.camera: view.row_delay for view in views},
        "spin_rad_s": spin.velocity.tolist() if spin else None,
        "spin_deviation_rad_s": np.sqrt(np.diag(spin.covariance)).tolist() if spin else None,
        "spin_points": spin.points if spin else 0,
        "rms_px": fall.rms,
        "views": fall.views,
        "frames": dict(zip(names, flight.frames)),
        "agreement": dict(zip(names, flight.agreement.tolist())) if flight.agreement is not None else None,
        "gravity": flight.gravity,
    }


def draw_flight(path: str | Path, flight: Flight, views: Sequence[Filmed], title: str) -> None:
    """Plot observed and fitted positions of the object's centre in each camera, and their distances."""
    figure = new_figure(5 * (len(views) + 1), 5)
    *cameras, last = figure.subplots(1, len(views) + 1)
    for number, (axes, view, track) in enumerate(zip(cameras, views, flight.tracks)):
        fitted = flight.fall.seen(track, number)
        axes.imshow(view.pixels[0][..., :3] // 2 + 127)
        axes.plot(*track.places.T, ".", label="seen")
        axes.plot(*fitted.T, "-", label="free flight")
        axes.set(title=view.camera, xlabel="x [px]", ylabel="y [px]")
        axes.legend()
        clock = track.times + flight.fall.offsets[number] - flight.fall.start
        last.plot(1000 * clock, np.linalg.norm(fitted - track.places, axis=1), ".-", label=view.camera)
    last.set(title="off the fit", xlabel="time [ms]", ylabel="[px]", yscale="log")
    last.legend()
    figure.suptitle(title)
    save_figure(path, figure)


def draw_tracks(path: str | Path, views: Sequence[Filmed], title: str) -> None:
    """Plot the positions of the object's centre in each camera, and which belong to its free flight."""
    figure = new_figure(5 * len(views), 5)
    for axes, view in zip(np.atleast_1d(figure.subplots(1, len(views))), views):
        axes.imshow(view.pixels[0][..., :3] // 2 + 127)
        axes.plot(*view.centroids.T, ".", label="seen")
        if view.flight is not None:
            flying = (view.numbers >= view.flight[0]) & (view.numbers <= view.flight[1])
            axes.plot(*view.centroids[flying].T, "x", label="free flight")
        axes.set(title=view.camera, xlabel="x [px]", ylabel="y [px]")
        axes.legend()
    figure.suptitle(title)
    save_figure(path, figure)
