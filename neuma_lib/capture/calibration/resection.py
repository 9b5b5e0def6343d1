"""Lens and pose of a fixed camera from one picture, with points triangulated in photographs.

In one picture, an offset of the principal point is nearly equivalent to a rotation of the camera, in particular for
flat scenes. Bundle adjustment with a free principal point drifts along this direction, and with a fixed one rotates the
camera. Therefore, points are estimated from the photographs alone, and residuals in the picture are weighted by the
points' covariances: a maximum a posteriori estimate with marginalised points (Triggs et al. 2000, section 6) and a
prior on the principal point from phones.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from neuma_lib.capture.calibration.lens import Lens

MIN_POINTS = 30  # points required to fit the lens of a picture
OFF_CENTRE = 0.01
"""Prior standard deviation of the principal point from the centre, as share of the longer side."""
RADIAL = (0.3, 0.1)  # prior standard deviations of k1 and k2
_OUTLIER = 3.0  # scale of the Cauchy loss, in standard deviations
_ROUNDS = 4  # of weights, which depend on the pose and on the noise of the picture
_STEP = 1e-5  # of numeric derivatives, relative to the distance of the points
_MAX_STEP = 0.2  # of a point in one iteration, relative to the spread of all


@dataclass(frozen=True, eq=False)
class Sighting:
    """Observations of points by a camera."""

    lens: Lens  # of the camera
    viewmat: np.ndarray  # world to camera, (4, 4)
    points: np.ndarray  # numbers of the points, (N,)
    pixels: np.ndarray  # (N, 2)


@dataclass(frozen=True, eq=False)
class Resected:
    """A fixed camera."""

    lens: Lens  # with square pixels, k1 and k2
    viewmat: np.ndarray  # world to camera, (4, 4)
    centre_deviation: np.ndarray  # standard deviation of the principal point, (2,) [px]
    turn_deviation: float  # standard deviation of the direction about the worst axis [degrees]


def triangulated(
    points: np.ndarray, sightings: Sequence[Sighting]
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Triangulate points by least squares.

    Args:
        points: initial guess, (P, 3).
        sightings: of cameras with known poses.

    Returns:
        Points (P, 3), their covariances (P, 3, 3) from the residuals, and whether at least two cameras see them, (P,).
        Other points and covariances are meaningless.
    """
    points = points.copy()
    spread = float(np.linalg.norm(points.std(axis=0)))
    seen = np.zeros(len(points), int)
    for sighting in sightings:
        np.add.at(seen, sighting.points, 1)
    known = seen >= 2
    for _ in range(_ROUNDS + 1):
        normal, gradient = np.tile(1e-9 * np.eye(3) / spread**2, (len(points), 1, 1)), np.zeros_like(points)
        residuals = []
        for sighting in sightings:
            of_points = points[sighting.points]
            residual = sighting.pixels - _project(sighting.lens, sighting.viewmat, of_points)
            slopes = _slopes(sighting.lens, sighting.viewmat, of_points)
            np.add.at(normal, sighting.points, np.einsum("nki,nkj->nij", slopes, slopes))
            np.add.at(gradient, sighting.points, np.einsum("nki,nk->ni", slopes, residual))
            residuals.append(residual[known[sighting.points]])
        step = np.linalg.solve(normal, gradient[..., None])[..., 0]
        length = np.linalg.norm(step, axis=1, keepdims=True)
        points += step * np.minimum(1, _MAX_STEP * spread / np.maximum(length, 1e-12 * spread))
    residual = np.concatenate(residuals)
    if not known.any():
        return points, np.linalg.inv(normal), known
    noise = _scatter(residual) * np.sqrt(residual.size / max(residual.size - 3 * known.sum(), 1))
    return points, noise**2 * np.linalg.inv(normal), known


def resect(
    points: np.ndarray, covariances: np.ndarray, pixels: np.ndarray, lens: Lens, viewmat: np.ndarray
) -> Resected:
    """Estimate a camera from observed points.

    Args:
        points: from other cameras, (N, 3).
        covariances: of the points, (N, 3, 3).
        pixels: observations of the points, (N, 2).
        lens, viewmat: initial guess.
    """
    middle = np.array([lens.width, lens.height]) / 2
    off_centre = OFF_CENTRE * max(lens.width, lens.height)
    far = float(np.median(points @ viewmat[2, :3] + viewmat[2, 3]))

    def camera(values: np.ndarray) -> tuple[Lens, np.ndarray]:
        moved = viewmat.copy()
        moved[:3, :3] = Rotation.from_rotvec(values[:3]).as_matrix() @ viewmat[:3, :3]
        moved[:3, 3] = viewmat[:3, 3] + far * values[3:6]
        K = np.array([[values[6], 0, values[7]], [0, values[6], values[8]], [0, 0, 1]])
        return replace(lens, K=K, distortion=np.array([*values[9:], 0, 0, 0])), moved

    def residuals(values: np.ndarray, whitening: np.ndarray) -> np.ndarray:
        residual = np.einsum("nkl,nl->nk", whitening, _project(*camera(values), points) - pixels)
        size = np.maximum(np.linalg.norm(residual, axis=1, keepdims=True), 1e-12)
        residual *= _OUTLIER * np.sqrt(np.log1p((size / _OUTLIER) ** 2)) / size
        return np.concatenate([residual.ravel(), (values[7:9] - middle) / off_centre, values[9:] / RADIAL])

    values = np.array([0, 0, 0, 0, 0, 0, lens.K[[0, 1], [0, 1]].mean(), *middle, *lens.distortion[:2]])
    noise = _scatter(_project(lens, viewmat, points) - pixels)
    for _ in range(_ROUNDS):
        slopes = _slopes(*camera(values), points)
        spread = noise**2 * np.eye(2) + np.einsum("nki,nij,nlj->nkl", slopes, covariances, slopes)
        whitening = np.linalg.inv(np.linalg.cholesky(spread))
        solution = least_squares(
            residuals, values, args=(whitening,), x_scale=[1e-3] * 6 + [1, 1, 1, 1e-2, 1e-2]
        )
        values = solution.x
        whitened = np.einsum("nkl,nl->nk", whitening, _project(*camera(values), points) - pixels)
        noise *= np.clip(_scatter(whitened), 0.5, 2)
    covariance = np.linalg.inv(solution.jac.T @ solution.jac)
    turn = np.sqrt(np.linalg.eigvalsh(covariance[:3, :3])[-1])
    return Resected(*camera(values), np.sqrt(np.diag(covariance)[7:9]), float(np.rad2deg(turn)))


def _project(lens: Lens, viewmat: np.ndarray, points: np.ndarray) -> np.ndarray:
    return lens.project(points @ viewmat[:3, :3].T + viewmat[:3, 3])


def _slopes(lens: Lens, viewmat: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Derivatives of the pixels by the points, (N, 2, 3)."""
    step = _STEP * float(np.median(np.abs(points @ viewmat[2, :3] + viewmat[2, 3])))
    sides = [[_project(lens, viewmat, points + sign * step * axis) for sign in (1, -1)] for axis in np.eye(3)]
    return np.stack([(above - below) / (2 * step) for above, below in sides], axis=2)


def _scatter(residuals: np.ndarray) -> float:
    """Standard deviation from the median absolute residual."""
    return max(1.4826 * float(np.median(np.abs(residuals))), 1e-6)
