"""Fit the free flight of an object's centre, x(t) = x0 + v0 t + a t^2 / 2 between release and contact."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import least_squares

from neuma_lib.capture.calibration.placement import project
from neuma_lib.capture.masks.agreement import CHECK_VIDEOS
from neuma_lib.capture.motion.ballistic_tracks import MIN_FRAMES
from neuma_lib.capture.motion.gravity import Gravity
from neuma_lib.errors import InputError

_MAX_RMS = 0.004  # tolerated root-mean-square residual, as share of the picture height
MAX_RMS_OF_RADIUS = 0.1
"""The same as share of the object's radius, since the centroid of a mask moves relative to the centre as the object
turns. Different takes that fit so well are refused by the check of gravity."""
TRIANGULATED, IN_PLANE = "triangulated", "one view in a plane"
AT_CONTACT = "one view in the plane of contact"  # how the distance of a fall from the cameras is known
_ENDS = 0.2  # share of a track at either end that the first fit leaves out
_MAX_DEVIATION = 4.0  # distance from the fit, in root mean squares of both coordinates
_MAX_CORRELATION = 0.95  # of neighbouring frames
_MIN_RMS = 0.2  # [px], accuracy of masks


@dataclass(frozen=True, eq=False)
class Track:
    """Undistorted positions of the object's centre in the pictures of one camera."""

    times: np.ndarray  # on the camera's clock [s], (T,)
    places: np.ndarray  # (x, y) [px], pixel centres at +0.5, (T, 2)
    viewmat: np.ndarray  # world to camera, OpenCV axes, (4, 4)
    K: np.ndarray  # intrinsics [px], (3, 3)
    name: str  # of the video for messages
    radius: float = 0.0  # of a circle with the area of the object [px]. 0 if unknown.


@dataclass(frozen=True, eq=False)
class FreeFall:
    """x(t) = x0 + v0 t + a t^2 / 2, with t relative to ``start`` on the clock of the first camera."""

    # x0, v0, a: [m], [m/s], [m/s^2], (3,) each
    x0: np.ndarray
    v0: np.ndarray
    a: np.ndarray
    offsets: np.ndarray  # seconds to add to the times of each camera, the first 0, (cameras,)
    # of (x0, v0, a, offsets without the first), (8 + cameras,) squared, including the correlation of
    # consecutive residuals. 0 for fixed values.
    covariance: np.ndarray
    start: float  # [s]
    rms: float  # of the residuals [px]
    views: str  # `TRIANGULATED`, `AT_CONTACT` or `IN_PLANE`, where the plane is an assumption
    # relative standard deviation of all lengths by that of the plane. 0 if triangulated.
    distance: float = 0.0

    def place(self, times: np.ndarray) -> np.ndarray:
        """Positions (T, 3) [m] at times on the first camera's clock [s]."""
        t = np.asarray(times, float)[:, None] - self.start
        return self.x0 + self.v0 * t + self.a * t**2 / 2

    def seen(self, track: Track, camera: int) -> np.ndarray:
        """Projection of the fall into a camera, by its number, at the times of a track, (T, 2) [px]."""
        return project(self.place(track.times + self.offsets[camera]), track.viewmat, track.K)

    @property
    def gravity(self) -> Gravity:
        """The acceleration with its covariance."""
        source = f"{self.views}, {self.rms:.2f} px"
        covariance = self.covariance[6:9, 6:9] + self.distance**2 * np.outer(self.a, self.a)
        return Gravity(self.a, covariance, source, self.views == TRIANGULATED, self.views != IN_PLANE)


def fit_free_fall(
    tracks: Sequence[Track],
    plane: tuple[np.ndarray, np.ndarray] | None = None,
    offsets: Sequence[float] | None = None,
    fixed: Sequence[bool] | None = None,
) -> FreeFall:
    """Fit the parabola by least squares of the reprojection errors.

    Several cameras triangulate within the fit. One camera needs the plane of the fall. Motion along its normal is then
    fixed, and the covariance does not include an error of the plane (`FreeFall.distance`).

    Args:
        tracks: of one camera or more, frames before contact only.
        plane: a point (3,) and a normal (3,), for one camera.
        offsets: seconds to add to the times of each camera, from sound, motion or the user, the first 0. None: zeros.
            The fit refines them below one frame, except the first.
        fixed: whether the offset of each camera is fixed. None: all but the first are fitted.

    Raises:
        InputError: too few frames, one camera without a plane, or motion that does not determine the fit.
    """
    for track in tracks:
        if len(track.times) < 4:
            raise InputError(
                track.name,
                f"{len(track.times)} frames before contact, at least 4 are required",
                "Film at more frames per second, or drop the object from a greater height",
            )
    if not tracks or (len(tracks) == 1 and plane is None):
        raise InputError(
            "plane",
            "one camera does not determine the distance of the object",
            "Give the plane of the fall, or film with a second camera at about 90 degrees",
        )
    start = float(tracks[0].times[0])
    basis, base = np.eye(9), np.zeros(9)
    if len(tracks) == 1:
        point, normal = (np.asarray(p, float) for p in plane)
        across = np.linalg.svd(normal[None] / np.linalg.norm(normal))[2][1:]  # two directions in the plane
        basis, base = np.kron(np.eye(3), across.T), np.concatenate([point, np.zeros(6)])
    known = np.zeros(len(tracks)) if offsets is None else np.asarray(offsets, float)
    fitted = [k for k in range(1, len(tracks)) if fixed is None or not fixed[k]]
    count, free = basis.shape[1], len(fitted)

    def motion(u: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        shift = known.copy()
        shift[fitted] = u[count:]
        return (base + basis @ u[:count]).reshape(3, 3), shift

    def residuals(u: np.ndarray) -> np.ndarray:
        (x0, v0, a), shift = motion(u)
        parts = []
        for track, offset in zip(tracks, shift):
            t = (track.times + offset - start)[:, None]
            parts.append(project(x0 + v0 * t + a * t**2 / 2, track.viewmat, track.K) - track.places)
        return np.concatenate(parts).ravel()

    linear = _linear(tracks, start, known, basis, base)
    solution = least_squares(
        residuals,
        np.concatenate([linear, known[fitted]]),
        x_scale="jac",
        method="trf",
        xtol=1e-12,
        ftol=1e-12,
    )
    u, errors, J = solution.x, solution.fun, solution.jac
    scale = np.linalg.norm(J, axis=0)
    singular = np.linalg.svd(J / np.maximum(scale, 1e-300), compute_uv=False)
    if not np.isfinite(u).all() or len(errors) <= len(u) or singular[-1] < 1e-7 * singular[0]:
        raise InputError(
            ", ".join(track.name for track in tracks),
            "the tracks do not determine the motion",
            "Use more frames, or cameras that look from different sides",
        )
    variance = errors @ errors / (len(errors) - len(u))
    lengths = [len(track.times) for track in tracks]
    variance *= _correlated_frames(np.split(errors.reshape(-1, 2), np.cumsum(lengths)[:-1]))
    covariance = variance * np.linalg.inv((J / scale).T @ (J / scale)) / np.outer(scale, scale)
    full = np.zeros((8 + len(tracks), count + free))
    full[:9, :count] = basis
    full[[8 + k for k in fitted], range(count, count + free)] = 1.0
    (x0, v0, a), shift = motion(u)
    return FreeFall(
        x0=x0,
        v0=v0,
        a=a,
        offsets=shift,
        covariance=full @ covariance @ full.T,
        start=start,
        rms=float(np.sqrt(np.mean(errors**2))),
        views=IN_PLANE if len(tracks) == 1 else TRIANGULATED,
    )


def _linear(
    tracks: Sequence[Track], start: float, offsets: np.ndarray, basis: np.ndarray, base: np.ndarray
) -> np.ndarray:
    """Unknowns of the parabola at these offsets by linear triangulation."""
    rows, values = [], []
    for track, offset in zip(tracks, offsets):
        P = track.K @ track.viewmat[:3]
        for t, place in zip(track.times + offset - start, track.places):
            # (p_k - place_k p_3) . (x, 1) = 0 for the rows p of the projection
            A = P[:2] - place[:, None] * P[2:]
            A = A / np.linalg.norm(A[:, :3], axis=1, keepdims=True)
            rows.append(np.kron([1.0, t, t * t / 2], A[:, :3]))
            values.append(-A[:, 3])
    M, y = np.concatenate(rows), np.concatenate(values)
    return np.linalg.lstsq(M @ basis, y - M @ base, rcond=None)[0]


def _correlated_frames(residuals: Sequence[np.ndarray]) -> float:
    """Frames per independent frame, (1 + r) / (1 - r) with the correlation r of neighbours in residuals (T, 2) [px].

    Exact for exponentially correlated noise (Bayley and Hammersley 1946).
    """
    # A constant residual moves the whole fall but does not change its shape.
    residuals = [part - part.mean(axis=0) for part in residuals]
    products = sum(float((part[1:] * part[:-1]).sum()) for part in residuals)
    squares = sum(0.5 * float((part[1:] ** 2 + part[:-1] ** 2).sum()) for part in residuals)
    r = np.clip(products / max(squares, 1e-300), 0.0, _MAX_CORRELATION)
    return float((1 + r) / (1 - r))


def fit_flight(
    tracks: Sequence[Track],
    plane: tuple[np.ndarray, np.ndarray] | None = None,
    offsets: Sequence[float] | None = None,
    fixed: Sequence[bool] | None = None,
    contact: float = np.inf,
) -> tuple[FreeFall, list[slice]]:
    """Fit the free flight within tracks that may start before release or end after contact.

    `fit_free_fall` starts with the middle of each track, which is extended in both directions while the fit predicts
    the next frame. One frame of contact, 1/120 s at 3 m/s, deviates by up to 25 mm and stops this. The contact of a
    soft body deviates less at first than the centroid of its mask varies, so its time must be given.

    Args:
        contact: time on the first camera's clock from which frames are left out, with the given offsets [s]. Ignored
            if fewer than `MIN_FRAMES` remain, as when the contact is with another surface than the floor.

    Returns:
        The fit, and the frames of each track that it uses.
    """
    kept = []
    shifts = np.zeros(len(tracks)) if offsets is None else offsets
    counts = [int((track.times + shift < contact).sum()) for track, shift in zip(tracks, shifts)]
    if min(counts) < MIN_FRAMES:
        counts = [len(track.times) for track in tracks]
    for count in counts:
        cut = min(int(_ENDS * count), max(0, (count - 4) // 2))
        kept.append([cut, count - cut])
    chosen = [_part(track, *ends) for track, ends in zip(tracks, kept)]
    fall = fit_free_fall(chosen, plane, offsets, fixed)
    growing = True
    while growing:
        growing = False
        for k, track in enumerate(tracks):
            for end, step in ((0, -1), (1, 1)):
                i = kept[k][0] - 1 if end == 0 else kept[k][1]
                if not 0 <= i < counts[k]:
                    continue
                distance = float(np.linalg.norm(fall.seen(_part(track, i, i + 1), k) - track.places[i]))
                if distance <= _MAX_DEVIATION * max(fall.rms, _MIN_RMS):
                    kept[k][end] += step
                    growing = True
        if growing:
            chosen = [_part(track, *ends) for track, ends in zip(tracks, kept)]
            fall = fit_free_fall(chosen, plane, fall.offsets, fixed)
    limit = min(max(_MAX_RMS * _height(track), MAX_RMS_OF_RADIUS * track.radius) for track in tracks)
    if fall.rms > limit:
        problem = f"no free flight fits the tracks: the error is {fall.rms:.1f} px, the limit {limit:.1f} px"
        raise InputError(", ".join(track.name for track in tracks), problem, CHECK_VIDEOS)
    return fall, [slice(*ends) for ends in kept]


def _part(track: Track, first: int, end: int) -> Track:
    return replace(track, times=track.times[first:end], places=track.places[first:end])


def _height(track: Track) -> float:
    """Approximate picture height: the optical axis is near the middle."""
    return 2 * float(track.K[1, 2])
