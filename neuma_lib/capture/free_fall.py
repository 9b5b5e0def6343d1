"""Free flight of an object's centre in metres.

Between release and contact the centre moves as x(t) = x0 + v0 t + a t^2 / 2, whatever the object is.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import least_squares

from neuma_lib.capture.arcs import LEAST_FRAMES
from neuma_lib.capture.gravity import Gravity
from neuma_lib.errors import InputError

MOST_RMS = 0.004
"""Distance of the places from the fit, as part of the picture's height, above which there is no one flight."""
MOST_OFF = 0.1
"""The same as part of the object's radius: the middle of its outline is not its centre, and wanders as it turns.
Different throws that fit so well show another gravity."""
TRIANGULATED = "triangulated"
_ENDS = 0.2  # part of a track at either end that the fit begins without
_OFF = 4.0  # distance that is still on the fit, in root mean squares of both coordinates
_MOST_ALIKE = 0.95  # correlation of neighbouring frames
_LEAST_RMS = 0.2  # [px], where the fit is closer than masks are


@dataclass(frozen=True, eq=False)
class Track:
    """Where a camera saw the object's centre, undistorted.

    Attributes:
        times: by the camera's clock [s], (T,).
        places: (x, y) [px], pixel centres at +0.5, (T, 2).
        viewmat: world to camera, OpenCV axes, (4, 4).
        K: intrinsics [px], (3, 3).
        name: of the video, for messages.
        radius: of the object's outline, as of a circle of its area [px]; 0: not known.
    """

    times: np.ndarray
    places: np.ndarray
    viewmat: np.ndarray
    K: np.ndarray
    name: str
    radius: float = 0.0


@dataclass(frozen=True, eq=False)
class FreeFall:
    """x(t) = x0 + v0 t + a t^2 / 2, t from ``start`` by the clock of the first camera.

    Attributes:
        x0, v0, a: [m], [m/s], [m/s^2], (3,) each.
        offsets: seconds to add to the times of each camera, the first 0, (cameras,).
        covariance: of (x0, v0, a, offsets without the first), (8 + cameras,) squared; 0 for what was stated. Residuals
            of frames that follow each other are alike, as the middle of an outline wanders; that is part of it.
        start: [s].
        rms: of the residuals [px].
        views: `TRIANGULATED` or "one view in a plane".
    """

    x0: np.ndarray
    v0: np.ndarray
    a: np.ndarray
    offsets: np.ndarray
    covariance: np.ndarray
    start: float
    rms: float
    views: str

    def place(self, times: np.ndarray) -> np.ndarray:
        """Places (T, 3) [m] at times by the first camera's clock [s]."""
        t = np.asarray(times, float)[:, None] - self.start
        return self.x0 + self.v0 * t + self.a * t**2 / 2

    def seen(self, track: Track, camera: int) -> np.ndarray:
        """Where a camera, by its number, sees the fall at the times of a track, (T, 2) [px]."""
        x = self.place(track.times + self.offsets[camera])
        p = (x @ track.viewmat[:3, :3].T + track.viewmat[:3, 3]) @ track.K.T
        return p[:, :2] / p[:, 2:]

    @property
    def gravity(self) -> Gravity:
        """The acceleration."""
        how = f"{self.views}, {self.rms:.2f} px"
        return Gravity(self.a, self.covariance[6:9, 6:9], how, self.views == TRIANGULATED)


def fit_free_fall(
    tracks: Sequence[Track],
    plane: tuple[np.ndarray, np.ndarray] | None = None,
    offsets: Sequence[float] | None = None,
    stated: Sequence[bool] | None = None,
) -> FreeFall:
    """Fit the parabola to what cameras saw, by least squares of the distances in the pictures.

    Several cameras triangulate within the fit. One camera needs the plane of the fall: a point (3,) and a normal (3,);
    what happens along the normal is then taken as known, and the covariance does not hold an error of the plane.

    Args:
        tracks: of one camera or more, of frames before contact only.
        plane: for one camera.
        offsets: what is to be added to each camera's times [s], from sound, motion or the user; None: nothing. The
            first is 0; the others are refined, below a frame, by when each camera saw the object at a height.
        stated: whether the offset of a camera is kept as it is; None: none of them.

    Raises:
        InputError: too few frames, one camera without a plane, or motion that does not determine the fit.
    """
    for track in tracks:
        if len(track.times) < 4:
            raise InputError(
                f"{track.name}: {len(track.times)} frames before contact, at least 4 are needed: film at more frames"
                f" a second, or drop the object from higher"
            )
    if not tracks or (len(tracks) == 1 and plane is None):
        raise InputError(
            "free fall: one camera cannot tell how far the object is: state the plane of the fall, or film with a"
            " second camera at about 90 degrees"
        )
    start = float(tracks[0].times[0])
    basis, base = np.eye(9), np.zeros(9)
    if len(tracks) == 1:
        point, normal = (np.asarray(p, float) for p in plane)
        across = np.linalg.svd(normal[None] / np.linalg.norm(normal))[2][1:]  # two directions in the plane
        basis, base = np.kron(np.eye(3), across.T), np.concatenate([point, np.zeros(6)])
    known = np.zeros(len(tracks)) if offsets is None else np.asarray(offsets, float)
    fitted = [k for k in range(1, len(tracks)) if stated is None or not stated[k]]
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
            p = ((x0 + v0 * t + a * t**2 / 2) @ track.viewmat[:3, :3].T + track.viewmat[:3, 3]) @ track.K.T
            parts.append(p[:, :2] / p[:, 2:] - track.places)
        return np.concatenate(parts).ravel()

    linear = _linear(tracks, start, known, basis, base)
    found = least_squares(
        residuals,
        np.concatenate([linear, known[fitted]]),
        x_scale="jac",
        method="trf",
        xtol=1e-12,
        ftol=1e-12,
    )
    J, scale = found.jac, np.linalg.norm(found.jac, axis=0)
    singular = np.linalg.svd(J / np.maximum(scale, 1e-300), compute_uv=False)
    if not np.isfinite(found.x).all() or len(found.fun) <= len(found.x) or singular[-1] < 1e-7 * singular[0]:
        raise InputError(
            f"free fall of {', '.join(t.name for t in tracks)}: the tracks do not determine the motion: use more"
            f" frames, or cameras that look from different sides"
        )
    variance = found.fun @ found.fun / (len(found.fun) - len(found.x))
    variance *= _alike(np.split(found.fun.reshape(-1, 2), np.cumsum([len(t.times) for t in tracks])[:-1]))
    covariance = variance * np.linalg.inv((J / scale).T @ (J / scale)) / np.outer(scale, scale)
    full = np.zeros((8 + len(tracks), count + free))
    full[:9, :count] = basis
    full[[8 + k for k in fitted], range(count, count + free)] = 1.0
    (x0, v0, a), shift = motion(found.x)
    return FreeFall(
        x0=x0,
        v0=v0,
        a=a,
        offsets=shift,
        covariance=full @ covariance @ full.T,
        start=start,
        rms=float(np.sqrt(np.mean(found.fun**2))),
        views="one view in a plane" if len(tracks) == 1 else TRIANGULATED,
    )


def _linear(
    tracks: Sequence[Track], start: float, offsets: np.ndarray, basis: np.ndarray, base: np.ndarray
) -> np.ndarray:
    """Unknowns of the parabola at these offsets, from equations that are linear in them (as of triangulation)."""
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


def _alike(residuals: Sequence[np.ndarray]) -> float:
    """Frames that count as one, 1 or more: (1 + r) / (1 - r) with the correlation r of neighbours, as of noise that
    forgets exponentially (Bayley and Hammersley 1946).

    Args:
        residuals: of each track, (T, 2) [px].
    """
    # What stays moves the whole fall, not its shape.
    residuals = [part - part.mean(axis=0) for part in residuals]
    products = sum(float((part[1:] * part[:-1]).sum()) for part in residuals)
    squares = sum(0.5 * float((part[1:] ** 2 + part[:-1] ** 2).sum()) for part in residuals)
    r = np.clip(products / max(squares, 1e-300), 0.0, _MOST_ALIKE)
    return float((1 + r) / (1 - r))


def fit_flight(
    tracks: Sequence[Track],
    plane: tuple[np.ndarray, np.ndarray] | None = None,
    offsets: Sequence[float] | None = None,
    stated: Sequence[bool] | None = None,
    contact: float = np.inf,
) -> tuple[FreeFall, list[slice]]:
    """`fit_free_fall` to the part of the tracks that is free flight: from the middle on, to both sides, as far as the
    next frame is where the fit of those before it says.

    At its ends a track may have a frame of the hand that lets go, or of the contact. One frame of contact, 1/120 s long
    at 3 m/s, is off by up to 25 mm. A soft body is off by much less at first, so that its contact hides in the wander
    of its outline's middle: it has to be known.

    Args:
        contact: frames from that time on are left out, by the first camera's clock, and by the offsets from the
            beginning [s]; but not where less than `LEAST_FRAMES` would be left, as over another floor.

    Returns:
        The fit, and which frames of each track it is of.
    """
    kept = []
    shifts = np.zeros(len(tracks)) if offsets is None else offsets
    counts = [int((track.times + shift < contact).sum()) for track, shift in zip(tracks, shifts)]
    if min(counts) < LEAST_FRAMES:
        counts = [len(track.times) for track in tracks]
    for count in counts:
        cut = min(int(_ENDS * count), max(0, (count - 4) // 2))
        kept.append([cut, count - cut])
    chosen = [_part(track, *ends) for track, ends in zip(tracks, kept)]
    fall = fit_free_fall(chosen, plane, offsets, stated)
    growing = True
    while growing:
        growing = False
        for k, track in enumerate(tracks):
            for end, step in ((0, -1), (1, 1)):
                i = kept[k][0] - 1 if end == 0 else kept[k][1]
                if not 0 <= i < counts[k]:
                    continue
                off = float(np.linalg.norm(fall.seen(_part(track, i, i + 1), k) - track.places[i]))
                if off <= _OFF * max(fall.rms, _LEAST_RMS):
                    kept[k][end] += step
                    growing = True
        if growing:
            chosen = [_part(track, *ends) for track, ends in zip(tracks, kept)]
            fall = fit_free_fall(chosen, plane, fall.offsets, stated)
    if fall.rms > min(max(MOST_RMS * _height(track), MOST_OFF * track.radius) for track in tracks):
        raise InputError(
            f"{', '.join(t.name for t in tracks)}: no free flight fits what the cameras saw, {fall.rms:.1f} px off:"
            f" are the videos of one throw and one object, have the cameras stood still since their poses were"
            f" found, and are the masks right? Look at the contact sheets"
        )
    return fall, [slice(*ends) for ends in kept]


def _part(track: Track, first: int, end: int) -> Track:
    return replace(track, times=track.times[first:end], places=track.places[first:end])


def _height(track: Track) -> float:
    """About the picture's height: the optical axis is near its middle."""
    return 2 * float(track.K[1, 2])
