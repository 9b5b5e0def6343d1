"""Spin of an object in free flight, from points of its surface that are followed in the pictures.

With no force but gravity an object turns about its centre, which keeps to the parabola of `FreeFall`. Over some tenths
of a second the angular velocity of a compact object hardly changes, and is taken as constant. How deep a followed point
lies is not known: it begins on a sphere of the mask's area and is fitted along with the spin.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from neuma_lib.capture.free_fall import FreeFall, Track
from neuma_lib.capture.tools import opencv

LONGEST = 8
"""Frames over which a point is followed; its neighbourhood turns away from the camera then."""
POINTS = 25
"""Points that are followed from one frame."""
DEPTH_SPREAD = 0.4
"""Deviation of the depth of a surface from that of a sphere, in radii."""
FOLLOWED = 0.3
"""Deviation of a followed point [px]."""
_LEAST_POINTS = 8
_WINDOW = 15  # side of what is compared around a point [px]
_RETURN = 0.5  # most distance of a point that was followed there and back [px]


@dataclass(frozen=True, eq=False)
class Path:
    """A point of the surface as one camera saw it.

    Attributes:
        camera: its number in the list of tracks.
        times: by that camera's clock [s], (T,).
        places: undistorted [px], (T, 2).
        radius: of a disc of the mask's area, at the first time [px].
    """

    camera: int
    times: np.ndarray
    places: np.ndarray
    radius: float


@dataclass(frozen=True, eq=False)
class Spin:
    """Angular velocity (3,) [rad/s], its covariance (3, 3), residual [px], and how many points it is from."""

    velocity: np.ndarray
    covariance: np.ndarray
    rms: float
    points: int

    @property
    def rate(self) -> tuple[float, float]:
        """Its size and deviation [rad/s]; along the axis, or all around where it hardly turns."""
        size = float(np.linalg.norm(self.velocity))
        axis = self.velocity / max(size, 1e-300)
        along = float(np.sqrt(axis @ self.covariance @ axis))
        return size, along if size > along else float(np.sqrt(np.trace(self.covariance) / 3))


def follow(frames: Sequence[np.ndarray], masks: np.ndarray, times: np.ndarray, camera: int) -> list[Path]:
    """Follow points inside the masks (Lucas and Kanade 1981, on pyramids), from every fourth frame on.

    Args:
        frames: of free flight, undistorted, T pictures (H, W, 3), uint8.
        masks: (T, H, W), none empty.
        times: (T,) [s].
        camera: number of the camera.
    """
    cv2 = opencv()
    grey = [cv2.cvtColor(frame, cv2.COLOR_RGB2GRAY) for frame in frames]
    # What is compared around a point should be the object; of a small one that would leave nothing.
    edge = 2 * max(2, min(_WINDOW // 2, round(0.25 * float(np.sqrt(masks[0].sum() / np.pi))))) + 1
    shape = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (edge, edge))
    inner = [cv2.erode(mask.astype(np.uint8), shape) for mask in masks]
    middles = [np.argwhere(mask).mean(axis=0)[::-1] for mask in masks]
    options = {"winSize": (_WINDOW, _WINDOW), "maxLevel": 2, "flags": cv2.OPTFLOW_USE_INITIAL_FLOW}
    paths = []
    for first in range(0, len(frames) - 2, max(1, LONGEST // 2)):
        found = cv2.goodFeaturesToTrack(grey[first], POINTS, 0.02, 4, mask=inner[first])
        if found is None:
            continue
        places = [[p] for p in found.reshape(-1, 2).astype(np.float64)]
        alive = np.arange(len(places))
        for i in range(first, min(first + LONGEST, len(frames)) - 1):
            here = np.array([places[k][-1] for k in alive], np.float32).reshape(-1, 1, 2)
            if len(here) == 0:
                break
            shift = (middles[i + 1] - middles[i]).astype(np.float32)
            there, good, _ = cv2.calcOpticalFlowPyrLK(grey[i], grey[i + 1], here, here + shift, **options)
            back, again, _ = cv2.calcOpticalFlowPyrLK(grey[i + 1], grey[i], there, there - shift, **options)
            x, y = np.rint(there[:, 0]).astype(int).T
            within = (x >= 0) & (y >= 0) & (x < grey[0].shape[1]) & (y < grey[0].shape[0])
            kept = (
                (good & again)[:, 0].astype(bool)
                & within
                & (np.linalg.norm(back - here, axis=2)[:, 0] < _RETURN)
            )
            kept[kept] &= inner[i + 1][y[kept], x[kept]] > 0
            alive = alive[kept]
            for k, place in zip(alive, there[kept, 0].astype(np.float64)):
                places[k].append(place)
        radius = float(np.sqrt(masks[first].sum() / np.pi))
        paths += [
            Path(camera, times[first : first + len(p)], np.array(p) + 0.5, radius)
            for p in places
            if len(p) > 2
        ]
    return paths


def fit_spin(paths: Sequence[Path], tracks: Sequence[Track], fall: FreeFall) -> Spin | None:
    """Angular velocity by least squares of the distances in the pictures, robust against points that slipped.

    Args:
        paths: of `follow`, of all cameras.
        tracks: of the cameras, for where they stand.
        fall: of the same flight.

    Returns:
        None where fewer than `_LEAST_POINTS` points were followed, as on an object without texture.
    """
    if len(paths) < _LEAST_POINTS:
        return None
    # One row for each place but the first of its path, which fixes the ray.
    path = np.concatenate([np.full(len(p.times) - 1, k) for k, p in enumerate(paths)])
    camera = np.array([p.camera for p in paths])
    R, t = (np.stack([track.viewmat[:3, c] for track in tracks]) for c in (slice(0, 3), 3))
    K = np.stack([track.K for track in tracks])
    clock = np.concatenate([p.times[1:] + fall.offsets[p.camera] for p in paths])
    begin = np.array([p.times[0] + fall.offsets[p.camera] for p in paths])
    seen = np.concatenate([p.places[1:] for p in paths])
    start = np.stack([p.places[0] for p in paths])
    centres, later = fall.place(begin), fall.place(clock)

    # A point is eye + depth * ray, where the ray has z = 1 in the camera.
    rays = np.concatenate(
        [(start - K[camera, :2, 2]) / K[camera][:, [0, 1], [0, 1]], np.ones((len(start), 1))], axis=1
    )
    rays = np.einsum("nji,nj->ni", R[camera], rays)
    eyes = -np.einsum("nji,nj->ni", R[camera], t[camera])
    nearest = np.einsum("ni,ni->n", centres - eyes, rays) / (rays**2).sum(axis=1)
    away = np.linalg.norm(eyes + nearest[:, None] * rays - centres, axis=1)
    radii = np.array([p.radius for p in paths]) * nearest / K[camera, 0, 0]
    lengths = np.linalg.norm(rays, axis=1)
    front = nearest - np.sqrt(np.maximum(radii**2 - away**2, (0.2 * radii) ** 2)) / lengths

    def residuals(u: np.ndarray) -> np.ndarray:
        depth = front + u[3:] * radii
        arm = (eyes + depth[:, None] * rays - centres)[path]
        turned = Rotation.from_rotvec((clock - begin[path])[:, None] * u[:3]).apply(arm)
        x = np.einsum("nij,nj->ni", R[camera[path]], later + turned) + t[camera[path]]
        p = x[:, :2] / x[:, 2:] * K[camera[path]][:, [0, 1], [0, 1]] + K[camera[path], :2, 2]
        return np.concatenate([((p - seen) / FOLLOWED).ravel(), u[3:] / DEPTH_SPREAD])

    def jacobian(u: np.ndarray) -> np.ndarray:
        # Depths act on the rows of their own paths only: one difference serves them all.
        J = np.zeros((2 * len(path) + len(paths), 3 + len(paths)))
        step = 1e-5
        for k in range(3):
            moved = u.copy()
            moved[k] += step
            back = u.copy()
            back[k] -= step
            J[:, k] = (residuals(moved) - residuals(back)) / (2 * step)
        moved, back = u.copy(), u.copy()
        moved[3:] += step
        back[3:] -= step
        change = (residuals(moved) - residuals(back)) / (2 * step)
        rows = np.arange(2 * len(path))
        J[rows, 3 + np.repeat(path, 2)] = change[: 2 * len(path)]
        J[2 * len(path) + np.arange(len(paths)), 3 + np.arange(len(paths))] = 1 / DEPTH_SPREAD
        return J

    found = least_squares(residuals, np.zeros(3 + len(paths)), jacobian, loss="soft_l1")
    off = residuals(found.x)[: 2 * len(path)]
    J = jacobian(found.x)
    weights = 1 / np.sqrt(1 + np.concatenate([off, found.x[3:] / DEPTH_SPREAD]) ** 2)
    inverse = np.linalg.inv(J.T @ (weights[:, None] * J))
    # Errors of a path's places are alike, as all are against its first: as good as one place, not as many.
    spread = max(1.0, float(np.median(np.abs(off)) * 1.4826) ** 2)
    alike = len(path) / len(paths)
    return Spin(
        found.x[:3], inverse[:3, :3] * spread * alike, float(FOLLOWED * np.sqrt(np.mean(off**2))), len(paths)
    )
