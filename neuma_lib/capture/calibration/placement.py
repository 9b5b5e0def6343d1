"""Triangulation, and the similarity that makes a reconstruction metric and upright."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from neuma_lib.errors import InputError

RANSAC_DRAWS = 2000  # RANSAC samples: 99 % probability of sampling the floor if it has 14 % of the points


@dataclass(frozen=True, eq=False)
class Similarity:
    """x -> scale rotation x + translation, with scale > 0, a proper rotation (3, 3) and translation (3,)."""

    scale: float = 1.0
    rotation: np.ndarray = field(default_factory=lambda: np.eye(3))
    translation: np.ndarray = field(default_factory=lambda: np.zeros(3))

    def apply(self, points: np.ndarray) -> np.ndarray:
        """Transform points (N, 3)."""
        return self.scale * points @ self.rotation.T + self.translation

    def after(self, first: Similarity) -> Similarity:
        """The composition: first ``first``, then this one."""
        return Similarity(
            self.scale * first.scale, self.rotation @ first.rotation, self.apply(first.translation[None])[0]
        )

    @staticmethod
    def read(values: Mapping[str, Any]) -> Similarity:
        """The similarity of `plain`."""
        return Similarity(values["scale"], np.array(values["rotation"]), np.array(values["translation"]))

    def inverse(self) -> Similarity:
        rotation = self.rotation.T
        return Similarity(1 / self.scale, rotation, -(rotation @ self.translation) / self.scale)

    def move_cameras(self, viewmats: np.ndarray) -> np.ndarray:
        """World to camera (N, 4, 4) after transforming the world. Projections of points do not change."""
        moved = viewmats.copy()
        moved[:, :3, :3] = viewmats[:, :3, :3] @ self.rotation.T
        moved[:, :3, 3] = self.scale * viewmats[:, :3, 3] - moved[:, :3, :3] @ self.translation
        return moved

    def plain(self) -> dict:
        """Entries of a file, read by ``Similarity.read``."""
        return {
            "scale": self.scale,
            "rotation": self.rotation.tolist(),
            "translation": self.translation.tolist(),
        }


def fit_similarity(source: np.ndarray, target: np.ndarray) -> Similarity:
    """Least-squares similarity between points (N, 3) (Umeyama 1991). Raises InputError for points on a line."""
    middle, aim = source.mean(axis=0), target.mean(axis=0)
    spread = np.linalg.svd(source - middle, compute_uv=False) if len(source) > 2 else np.zeros(3)
    if spread[1] <= 1e-6 * spread[0] or spread[0] == 0:
        raise InputError("source", "at least three points that are not on a line are required")
    U, values, Vt = np.linalg.svd((target - aim).T @ (source - middle))
    signs = np.array([1.0, 1.0, np.sign(np.linalg.det(U @ Vt))])
    rotation = U @ np.diag(signs) @ Vt
    scale = float((values * signs).sum() / ((source - middle) ** 2).sum())
    return Similarity(scale, rotation, aim - scale * rotation @ middle)


def camera_centres(viewmats: np.ndarray) -> np.ndarray:
    """Centres (N, 3) of cameras (N, 4, 4), world to camera."""
    return -np.einsum("nji,nj->ni", viewmats[:, :3, :3], viewmats[:, :3, 3])


def unit_rays(viewmats: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """Unit vectors (N, 3) in the world towards x/z and y/z (N, 2) in the frames of cameras (N, 4, 4)."""
    rays = np.concatenate([directions, np.ones((len(directions), 1))], axis=1)
    return np.einsum("nji,nj->ni", viewmats[:, :3, :3], rays / np.linalg.norm(rays, axis=1, keepdims=True))


def project(points: np.ndarray, viewmat: np.ndarray, K: np.ndarray) -> np.ndarray:
    """Pixels (N, 2) of points (N, 3) in front of a pinhole camera: world to camera (4, 4), intrinsics (3, 3)."""
    pixels = (points @ viewmat[:3, :3].T + viewmat[:3, 3]) @ K.T
    return pixels[:, :2] / pixels[:, 2:]


def triangulate(
    viewmats: np.ndarray, directions: np.ndarray, iterations: int = 10
) -> tuple[np.ndarray, float]:
    """Triangulate a point: nearest point to all rays, then Gauss-Newton on x/z and y/z.

    Args:
        viewmats: world to camera, (N, 4, 4), N >= 2.
        directions: x/z and y/z of the point in each camera, (N, 2).
        iterations: of Gauss-Newton.

    Returns:
        The point (3,), NaN if it is behind a camera or the rays are parallel, and the largest angle between two rays
        [rad].
    """
    R, t, rays = viewmats[:, :3, :3], viewmats[:, :3, 3], unit_rays(viewmats, directions)
    angle = float(np.arccos(np.clip((rays @ rays.T).min(), -1, 1)))
    away = np.eye(3) - np.einsum("ni,nj->nij", rays, rays)
    normal = away.sum(axis=0)
    if np.linalg.cond(normal) > 1e12:
        return np.full(3, np.nan), angle
    point = np.linalg.solve(normal, np.einsum("nij,nj->i", away, camera_centres(viewmats)))
    for _ in range(iterations):
        seen = R @ point + t
        if (seen[:, 2] <= 0).any():
            return np.full(3, np.nan), angle
        residual = seen[:, :2] / seen[:, 2:] - directions
        J = (R[:, :2] - (seen[:, :2] / seen[:, 2:])[:, :, None] * R[:, 2:]) / seen[:, 2:, None]
        point = point - np.linalg.lstsq(J.reshape(-1, 3), residual.reshape(-1), rcond=None)[0]
    return point, angle


def fit_floor(
    points: np.ndarray,
    cameras: np.ndarray,
    tolerance: float,
    seed: int,
    up: np.ndarray | None = None,
    max_angle: float = 180.0,
) -> tuple[np.ndarray, np.ndarray, float]:
    """RANSAC fit of the plane with the most points near it that has all cameras on one side.

    Args:
        points: of the reconstruction, (N, 3).
        cameras: centres of the cameras, (M, 3).
        tolerance: distance from the plane of near points.
        seed: of the random samples.
        up: upward direction, unit vector (3,). None: unknown.
        max_angle: of the normal from ``up`` [degrees]. It excludes walls, which often have more points.

    Returns:
        A point of the plane (3,), its unit normal (3,) towards the cameras, and the share of near points.

    Raises:
        InputError: no plane with at least a tenth of the points.
    """
    rng = np.random.default_rng(seed)
    best, near = 0, None
    for _ in range(RANSAC_DRAWS if len(points) >= 3 else 0):
        a, b, c = points[rng.choice(len(points), 3, replace=False)]
        normal = np.cross(b - a, c - a)
        size = np.linalg.norm(normal)
        if size < 1e-12:
            continue
        normal /= size
        sides = (cameras - a) @ normal
        if not (np.sign(sides) == np.sign(sides[0])).all():
            continue
        if up is not None and np.sign(sides[0]) * (normal @ up) < np.cos(np.radians(max_angle)):
            continue
        inliers = np.abs((points - a) @ normal) < tolerance
        if inliers.sum() > best:
            best, near = int(inliers.sum()), inliers
    if near is None or best < max(10, 0.1 * len(points)):
        level = "" if up is None else f" within {max_angle:.0f} degrees of the level of the cameras"
        raise InputError(
            "photographs",
            f"no floor detected: the best plane{level} has {best} of {len(points)} points, a tenth and at least 10"
            " are required",
            "Lay down the printed board, or photograph more of a floor with texture",
        )
    for _ in range(3):  # least squares and selection of near points in turn
        middle = points[near].mean(axis=0)
        normal = np.linalg.svd(points[near] - middle, full_matrices=False)[2][2]
        near = np.abs((points - middle) @ normal) < tolerance
    normal = normal * np.sign((cameras - middle).mean(axis=0) @ normal)
    return middle, normal, float(near.mean())


def upright(normal: np.ndarray, origin: np.ndarray) -> Similarity:
    """The rigid motion that maps a floor to y = 0, its unit normal (3,) to +y and its point ``origin`` (3,) to 0."""
    least = np.eye(3)[np.abs(normal).argmin()]
    x = np.cross(normal, least)
    x /= np.linalg.norm(x)
    rotation = np.stack([x, normal, np.cross(x, normal)])
    return Similarity(1.0, rotation, -(rotation @ origin))


def scale_from_length(
    viewmats: Sequence[np.ndarray], directions: Sequence[np.ndarray], metres: float
) -> float:
    """Metres per unit of a reconstruction, from the two ends of a known length in several views.

    In one view, the ends are on the floor at y = 0.

    Args:
        viewmats: world to camera of the views, (N, 4, 4).
        directions: x/z and y/z of the ends in each view, (N, 2, 2).
        metres: the length.

    Raises:
        InputError: the ends cannot be triangulated.
    """
    views, seen = np.asarray(viewmats), np.asarray(directions)
    if len(views) == 1:
        eye, rays = camera_centres(views)[0], unit_rays(views.repeat(2, axis=0), seen[0])
        ends = [eye - eye[1] / ray[1] * ray if ray[1] < 0 else np.full(3, np.nan) for ray in rays]
    else:
        ends = [triangulate(views, seen[:, end])[0] for end in (0, 1)]
    distance = float(np.linalg.norm(ends[1] - ends[0]))
    if not distance > 0:
        raise InputError(
            "length.ends",
            "the marked points cannot be triangulated",
            "Mark the same two points, in the same order, in photographs from different sides, or two points on the"
            " floor in one photograph",
        )
    return metres / distance
