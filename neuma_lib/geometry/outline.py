"""The outline of a closed triangle mesh in an image, as points of the mesh, and silhouettes."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from skimage.draw import polygon

Array = NDArray[np.float64]

_PARTS = 4  # of an edge that are visible or hidden as a whole
_OFFSET = 1e-3  # distance of a test point from the edge, in units of the edge's length
_CHUNK = 4_000_000  # pairs of points and triangles at once


@dataclass(frozen=True, eq=False)
class Outline:
    """Segments of the outer boundary of a projected mesh."""

    vertices: NDArray[np.int64]  # of the mesh at the two ends of each segment's edge, shape (M, 2)
    # positions of the segment's ends along the edge, from 0 at the first vertex to 1, shape (M, 2)
    shares: Array

    def ends(self, values: Array) -> Array:
        """Values (P, k) of the vertices at the ends of the segments, shape (M, 2, k)."""
        first, second = values[self.vertices[:, :1]], values[self.vertices[:, 1:]]
        return first + self.shares[..., None] * (second - first)

    def nearest(self, pixels: Array, points: Array) -> tuple[NDArray[np.int64], Array, Array]:
        """The nearest point of the outline to each of Q image points.

        Args:
            pixels: projected vertices, shape (P, 2) [px].
            points: shape (Q, 2) [px].

        Returns:
            Its segment (Q,), weight of the second vertex of the segment's edge (Q,), and offset from the image point
            (Q, 2) [px].
        """
        a, b = self.ends(pixels).transpose(1, 0, 2)
        along = b - a
        squared = np.maximum((along**2).sum(axis=1), 1e-12)
        share = np.clip(((points[:, None] - a) * along).sum(axis=2) / squared, 0, 1)
        offsets = a + share[..., None] * along - points[:, None]
        segment = (offsets**2).sum(axis=2).argmin(axis=1)
        rows = np.arange(len(points))
        low, high = self.shares[segment].T
        return segment, low + share[rows, segment] * (high - low), offsets[rows, segment]


def outline(pixels: Array, triangles: NDArray[np.int64]) -> Outline:
    """The outer boundary of the union of projected triangles.

    An edge of the mesh can be part of it if one of its triangles faces the camera and the other does not. Quarters of
    such edges are, if no triangle covers a point next to their middle, so that the outline is accurate to a quarter of
    an edge where one part of the body passes in front of another, and exact elsewhere.

    Args:
        pixels: projected vertices of a closed mesh, all in front of the camera, shape (P, 2) [px].
        triangles: oriented alike, shape (T, 3).
    """
    corners = pixels[triangles]
    u, v = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    doubled = u[:, 0] * v[:, 1] - u[:, 1] * v[:, 0]
    edges = np.concatenate([triangles[:, [0, 1]], triangles[:, [1, 2]], triangles[:, [2, 0]]])
    owner = np.tile(np.arange(len(triangles)), 3)
    order = np.lexsort(np.sort(edges, axis=1).T)
    pairs = order[: 2 * (len(order) // 2)].reshape(-1, 2)  # the two triangles of each edge
    sides = doubled[owner[pairs]] > 0
    rim = edges[pairs[sides[:, 0] != sides[:, 1], 0]]
    near = owner[pairs[sides[:, 0] != sides[:, 1]]]
    # both triangles lie on one side of a rim's edge
    larger = near[np.arange(len(near)), np.abs(doubled[near]).argmax(axis=1)]
    a, b = pixels[rim[:, 0]], pixels[rim[:, 1]]
    away = (a + b) / 2 - pixels[triangles[larger]].mean(axis=1)
    normal = np.stack([b[:, 1] - a[:, 1], a[:, 0] - b[:, 0]], axis=1)
    normal *= np.sign((normal * away).sum(axis=1))[:, None]
    steps = np.arange(_PARTS + 1) / _PARTS
    shares = np.stack([steps[:-1], steps[1:]], axis=1)
    middles = shares.mean(axis=1)[:, None]
    tested = a[:, None] + middles * (b - a)[:, None] + _OFFSET * normal[:, None]
    free = ~_covered(tested.reshape(-1, 2), corners[doubled > 0] if (doubled > 0).any() else corners)
    free = free.reshape(-1, _PARTS) & ((b - a) ** 2).sum(axis=1, keepdims=True).astype(bool)
    edge, part = np.nonzero(free)
    return Outline(rim[edge], shares[part])


def _covered(points: Array, triangles: Array) -> NDArray[np.bool_]:
    """Which points (Q, 2) lie in one of the triangles (T, 3, 2), all of one orientation."""
    result = np.zeros(len(points), dtype=bool)
    a, b, c = triangles.transpose(1, 0, 2)
    lines = []  # x y 1 -> twice the area of the triangle of the point and an edge
    for p, q in ((a, b), (b, c), (c, a)):
        d = q - p
        lines.append(np.stack([-d[:, 1], d[:, 0], d[:, 1] * p[:, 0] - d[:, 0] * p[:, 1]]))
    for start in range(0, len(points), max(1, _CHUNK // max(1, len(triangles)))):
        part = slice(start, start + max(1, _CHUNK // max(1, len(triangles))))
        own = np.column_stack([points[part], np.ones(len(points[part]))])
        inside = own @ lines[0] >= 0
        inside &= own @ lines[1] >= 0
        inside &= own @ lines[2] >= 0
        result[part] = inside.any(axis=1)
    return result


def silhouette(pixels: Array, triangles: NDArray[np.int64], height: int, width: int) -> NDArray[np.bool_]:
    """Pixels whose centres, at half integers, are covered by projected triangles, shape (height, width)."""
    result = np.zeros((height, width), dtype=bool)
    for corners in pixels[triangles] - 0.5:
        rows, columns = polygon(corners[:, 1], corners[:, 0], result.shape)
        result[rows, columns] = True
    return result
