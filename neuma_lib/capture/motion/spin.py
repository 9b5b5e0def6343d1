"""Angular velocity of an object in free flight, from tracked points of its surface.

Under gravity alone an object rotates about its centre, which follows the parabola of `FreeFall`. The angular velocity
of a compact object is nearly constant over a few tenths of a second. The depths of the points are unknown: they start
on a sphere with the area of the mask and are fitted together with the angular velocity.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from neuma_lib.capture.calibration.placement import camera_centres
from neuma_lib.capture.masks.regions import radius_of
from neuma_lib.capture.motion.free_fall import FreeFall, Track
from neuma_lib.capture.tools import opencv

_MAX_FRAMES = 8  # frames over which a point is tracked before its neighbourhood rotates out of view
_POINTS = 25  # points tracked from one frame
_DEPTH_SPREAD = 0.4  # standard deviation of the depth of a surface from that of a sphere, in radii
PIXEL_SPREAD = 0.3  # standard deviation of a tracked point [px]
_MIN_POINTS = 8
_WINDOW = 15  # side of the window compared around a point [px]
_MAX_RETURN_ERROR = 0.5  # after tracking forward and backward [px]


@dataclass(frozen=True, eq=False)
class Path:
    """Track of a surface point in one camera."""

    camera: int  # its number in the list of tracks
    times: np.ndarray  # on that camera's clock [s], (T,)
    places: np.ndarray  # undistorted [px], (T, 2)
    radius: float  # of a disc with the area of the mask, at the first time [px]


@dataclass(frozen=True, eq=False)
class Spin:
    """Angular velocity (3,) [rad/s], its covariance (3, 3), residual [px], and number of points."""

    velocity: np.ndarray
    covariance: np.ndarray
    rms: float
    points: int

    @property
    def rate(self) -> tuple[float, float]:
        """Magnitude and standard deviation [rad/s], along the axis, or the mean over all axes for a small spin."""
        size = float(np.linalg.norm(self.velocity))
        axis = self.velocity / max(size, 1e-300)
        along = float(np.sqrt(axis @ self.covariance @ axis))
        return size, along if size > along else float(np.sqrt(np.trace(self.covariance) / 3))


def follow(frames: Sequence[np.ndarray], masks: np.ndarray, times: np.ndarray, camera: int) -> list[Path]:
    """Track points inside the masks (pyramidal Lucas and Kanade 1981), starting at every fourth frame.

    Args:
        frames: of free flight, undistorted, T pictures (H, W, 3), uint8.
        masks: (T, H, W), none empty.
        times: (T,) [s].
        camera: number of the camera.
    """
    cv2 = opencv()
    grey = [cv2.cvtColor(frame, cv2.COLOR_RGB2GRAY) for frame in frames]
    # Windows should be inside the object, but a small object must keep some pixels.
    edge = 2 * max(2, min(_WINDOW // 2, round(0.25 * radius_of(masks[0])))) + 1
    shape = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (edge, edge))
    inner = [cv2.erode(mask.astype(np.uint8), shape) for mask in masks]
    middles = [np.argwhere(mask).mean(axis=0)[::-1] for mask in masks]
    options = {"winSize": (_WINDOW, _WINDOW), "maxLevel": 2, "flags": cv2.OPTFLOW_USE_INITIAL_FLOW}
    paths = []
    for first in range(0, len(frames) - 2, max(1, _MAX_FRAMES // 2)):
        features = cv2.goodFeaturesToTrack(grey[first], _POINTS, 0.02, 4, mask=inner[first])
        if features is None:
            continue
        places = [[p] for p in features.reshape(-1, 2).astype(np.float64)]
        alive = np.arange(len(places))
        for i in range(first, min(first + _MAX_FRAMES, len(frames)) - 1):
            here = np.array([places[k][-1] for k in alive], np.float32).reshape(-1, 1, 2)
            if len(here) == 0:
                break
            shift = (middles[i + 1] - middles[i]).astype(np.float32)
            there, good, _ = cv2.calcOpticalFlowPyrLK(grey[i], grey[i + 1], here, here + shift, **options)
            back, again, _ = cv2.calcOpticalFlowPyrLK(grey[i + 1], grey[i], there, there - shift, **options)
            x, y = np.rint(there[:, 0]).astype(int).T
            within = (x >= 0) & (y >= 0) & (x < grey[0].shape[1]) & (y < grey[0].shape[0])
            returned = np.linalg.norm(back - here, axis=2)[:, 0] < _MAX_RETURN_ERROR
            kept = (good & again)[:, 0].astype(bool) & within & returned
            kept[kept] &= inner[i + 1][y[kept], x[kept]] > 0
            alive = alive[kept]
            for k, place in zip(alive, there[kept, 0].astype(np.float64)):
                places[k].append(place)
        radius = radius_of(masks[first])
        long = [p for p in places if len(p) > 2]
        paths += [Path(camera, times[first : first + len(p)], np.array(p) + 0.5, radius) for p in long]
    return paths


def fit_spin(paths: Sequence[Path], tracks: Sequence[Track], fall: FreeFall) -> Spin | None:
    """Angular velocity by robust least squares of the reprojection errors.

    Args:
        paths: of `follow`, of all cameras.
        tracks: of the cameras, for their poses.
        fall: of the same flight.

    Returns:
        None if fewer than `_MIN_POINTS` points were tracked, as on an object without texture.
    """
    if len(paths) < _MIN_POINTS:
        return None
    # One row for each position of a path but the first, which fixes the ray.
    path = np.concatenate([np.full(len(p.times) - 1, k) for k, p in enumerate(paths)])
    camera = np.array([p.camera for p in paths])
    R, t = (np.stack([track.viewmat[:3, c] for track in tracks]) for c in (slice(0, 3), 3))
    K = np.stack([track.K for track in tracks])
    clock = np.concatenate([p.times[1:] + fall.offsets[p.camera] for p in paths])
    begin = np.array([p.times[0] + fall.offsets[p.camera] for p in paths])
    seen = np.concatenate([p.places[1:] for p in paths])
    start = np.stack([p.places[0] for p in paths])
    centres, later = fall.place(begin), fall.place(clock)

    # A point is eye + depth * ray, with z = 1 for the ray in the camera's frame.
    rays = np.concatenate(
        [(start - K[camera, :2, 2]) / K[camera][:, [0, 1], [0, 1]], np.ones((len(start), 1))], axis=1
    )
    rays = np.einsum("nji,nj->ni", R[camera], rays)
    eyes = camera_centres(np.stack([track.viewmat for track in tracks]))[camera]
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
        return np.concatenate([((p - seen) / PIXEL_SPREAD).ravel(), u[3:] / _DEPTH_SPREAD])

    def jacobian(u: np.ndarray) -> np.ndarray:
        # A depth only affects the rows of its path, so one finite difference covers all depths.
        def slope(unknowns: int | slice) -> np.ndarray:
            step = np.zeros(len(u))
            step[unknowns] = 1e-5
            return (residuals(u + step) - residuals(u - step)) / 2e-5

        J = np.zeros((2 * len(path) + len(paths), 3 + len(paths)))
        for k in range(3):
            J[:, k] = slope(k)
        change, rows = slope(slice(3, None)), np.arange(2 * len(path))
        J[rows, 3 + np.repeat(path, 2)] = change[: 2 * len(path)]
        J[2 * len(path) + np.arange(len(paths)), 3 + np.arange(len(paths))] = 1 / _DEPTH_SPREAD
        return J

    u = least_squares(residuals, np.zeros(3 + len(paths)), jacobian, loss="soft_l1").x
    errors = residuals(u)[: 2 * len(path)]
    J = jacobian(u)
    weights = 1 / np.sqrt(1 + np.concatenate([errors, u[3:] / _DEPTH_SPREAD]) ** 2)
    inverse = np.linalg.inv(J.T @ (weights[:, None] * J))
    # All positions of a path share the error of the first, so a path counts as one independent position.
    spread = max(1.0, float(np.median(np.abs(errors)) * 1.4826) ** 2)
    correlated = len(path) / len(paths)
    rms = float(PIXEL_SPREAD * np.sqrt(np.mean(errors**2)))
    return Spin(u[:3], inverse[:3, :3] * spread * correlated, rms, len(paths))
