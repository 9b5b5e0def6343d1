"""Shape of revolution from silhouettes of one camera in free flight.

The axis of a body of revolution is nearest to the picture plane in the most elongated silhouette. The half widths of
this silhouette along the axis are the profile. Each other silhouette must be that of the same body at another tilt.
The smaller deviation decides whether the axis is the longer or the shorter one of the silhouette, a rod or a disc.
Motion blur looks like a rod along the motion, so silhouettes that are longer along their motion are refused.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import trimesh

from neuma_lib.capture.masks.regions import centroid, radius_of, shrunk
from neuma_lib.capture.tools import opencv

TOLERANCE = 0.06
"""Tolerated mean distance between the edges of silhouette and body, of the radius, but at least one pixel."""
_MAX_RADIUS = 40.0  # radius of a silhouette that is compared [px]. Larger ones are reduced.
_TILTS = np.radians(np.arange(0, 91, 5))  # of the axis out of the picture plane


class Revolution(NamedTuple):
    """The best body of revolution of T silhouettes. Lengths in pixels of the video."""

    mesh: trimesh.Trimesh  # closed surface about the z axis
    deviations: np.ndarray  # mean distance between the edges of each silhouette and of the body, (T,)
    pairs: np.ndarray  # each silhouette, turned so that the axis is vertical, and the body's, (T, 2, M, M)
    report: dict[str, Any]  # largest deviations, those tolerated, and whether it is one, or a ball


def fit_revolution(masks: np.ndarray, velocities: np.ndarray) -> Revolution:
    """Fit a body of revolution to silhouettes of free flight. Its axis may turn from one to the next.

    The camera is assumed to be far away, and one silhouette to show the axis in the picture plane.

    Args:
        masks: silhouettes (T, H, W), none empty.
        velocities: of their centres, (T, 2), in pixels per any time.
    """
    radius = float(np.median([radius_of(mask) for mask in masks]))
    scale = min(1.0, _MAX_RADIUS / radius)
    moments = [np.linalg.eigh(np.cov(np.argwhere(mask)[:, ::-1].T)) for mask in masks]
    longest = scale * max(np.sqrt(12 * variances[1]) for variances, _ in moments)
    half = int(np.ceil(0.85 * longest)) + 2  # of a cone, whose centroid is farthest from an end
    reference = int(np.argmax([variances[1] / variances[0] for variances, _ in moments]))
    fits = []
    for column in (1, 0):  # the axis is the longer or the shorter one
        turned = [_turned(mask, axes[:, column], scale, half) for mask, (_, axes) in zip(masks, moments)]
        profile = turned[reference].sum(axis=1) / 2
        distances, pairs, tilts = _fitted(profile, turned)
        if (aligned := pairs[tilts == 0, 0]).size:  # less noise than one silhouette
            profile = aligned.mean(axis=0).sum(axis=1) / 2
            distances, pairs, tilts = _fitted(profile, turned)
        fits.append((distances / scale, profile / scale, pairs))
    (deviations, profile, pairs), (other, _, _) = sorted(fits, key=lambda fit: fit[0].max())
    inside = np.flatnonzero(profile >= 0.5)
    rows = np.arange(inside[0], inside[-1] + 1)
    z = np.concatenate([rows[:1] - 0.5, rows, rows[-1:] + 0.5]) - half
    radii = np.pad(np.maximum(np.pad(profile[rows], 1, mode="edge"), 0.5), 1)
    line = np.stack([radii, np.pad(z / scale, 1, mode="edge")], axis=1)
    y, x = np.mgrid[-half : half + 1, -half : half + 1]
    disc = max(_distance(t, x**2 + y**2 <= t.sum() / np.pi) for t in turned) / scale
    blur = np.median(
        [
            np.subtract(*np.ptp(np.argwhere(mask)[:, ::-1] @ [[u, -v], [v, u]], axis=0)) / np.hypot(u, v)
            for mask, (u, v) in zip(masks, velocities)
        ]
    )
    limit = max(1.0, TOLERANCE * radius)
    report = {
        "deviation_px": float(deviations.max()),
        "other_axis_px": float(other.max()),
        "disc_px": disc,
        "blur_px": float(blur),  # length along the motion less that across it
        "limit_px": limit,
        "agrees": bool(max(deviations.max(), blur / 2) <= limit),
        "ball": bool(max(disc, blur / 2) <= limit),
    }
    return Revolution(trimesh.creation.revolve(line, sections=48), deviations, pairs, report)


def _turned(mask: np.ndarray, axis: np.ndarray, scale: float, half: int) -> np.ndarray:
    """A silhouette with its centroid in the middle of (2 half + 1) squared pixels and an axis (x, y) vertical."""
    rotation = scale * np.array([[-axis[1], axis[0]], [axis[0], axis[1]]])
    matrix = np.column_stack([rotation, half - rotation @ (centroid(mask) - 0.5)])
    return opencv().warpAffine(mask.astype(np.float32), matrix, (2 * half + 1, 2 * half + 1)) > 0.5


def _fitted(profile: np.ndarray, turned: list[np.ndarray]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Smallest distances [px] of silhouettes, either way up, from a body, both pictures, and indices of tilts."""
    bodies = [_silhouette(profile, tilt) for tilt in _TILTS]
    results = []
    for picture in turned:
        choices = [(p, body) for body in bodies for p in (picture, np.ascontiguousarray(picture[::-1]))]
        distances = [_distance(*choice) for choice in choices]
        best = int(np.argmin(distances))
        results.append((distances[best], np.array(choices[best]), best // 2))
    distances, pairs, tilts = map(np.array, zip(*results))
    return distances, pairs, tilts


def _silhouette(profile: np.ndarray, tilt: float) -> np.ndarray:
    """Silhouette of the body with radii (M,) along a vertical axis, tilted out of the picture plane, (M, M)."""
    z, discs = np.arange(len(profile)) - len(profile) // 2, np.flatnonzero(profile)
    with np.errstate(invalid="ignore"):
        depth = np.sqrt(profile[discs, None] ** 2 - z**2)  # of each disc at each column, NaN outside
    reach, middle = np.cos(tilt) / 2 + np.sin(tilt) * depth, 0.0
    for _ in range(2):  # silhouettes are compared at their centroids
        rows = z[:, None, None] + middle  # row, disc, column
        picture = (np.abs(rows - np.cos(tilt) * z[discs, None]) <= reach).any(axis=1)
        middle = (picture.sum(axis=1) @ z) / picture.sum()
    return picture


def _distance(a: np.ndarray, b: np.ndarray) -> float:
    """Mean distance between the edges of two silhouettes [px]: the area between them, of the length of the first."""
    return float((a ^ b).sum() / (a & ~shrunk(a, 1)).sum())
