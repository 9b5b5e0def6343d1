"""The inside of a closed surface: membership, evenly spread points, overlap of two bodies.

Meshes are `trimesh.Trimesh` in metres, watertight and oriented outwards; points are float64 arrays.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations
from typing import Literal

import numpy as np
import trimesh
from numpy.typing import NDArray

from neuma_lib.errors import InputError

Array = NDArray[np.float64]

_CHUNK_PAIRS = 2_000_000
"""Point-triangle pairs tested at one time."""
_ATTEMPTS = 12
"""Samplings tried for a count near the wanted one."""
_COUNT_TOLERANCE = 0.01
"""Relative error of the count at which no further sampling is tried; the promise is 5 %."""


def check_mesh(mesh: trimesh.Trimesh, name: str = "mesh") -> None:
    """Make sure that a mesh has an inside.

    Raises:
        InputError: no faces, vertices that are not finite, holes, or faces that point inwards.
    """
    if len(mesh.faces) == 0:
        raise InputError(f"{name}: has no faces")
    finite = np.isfinite(mesh.vertices).all(axis=1)
    if not finite.all():
        raise InputError(f"{name}: vertex {int(np.argmin(finite))} is not finite; export the mesh again")
    if not mesh.is_watertight:
        raise InputError(
            f"{name}: is not watertight, so it has no volume to fill; close its holes (for example with "
            "trimesh.repair.fill_holes or a voxel remesh)"
        )
    if mesh.volume <= 0:
        raise InputError(f"{name}: encloses no positive volume; its faces point inwards, flip them")


def inside(mesh: trimesh.Trimesh, points: Array) -> NDArray[np.bool_]:
    """Which points lie inside a closed mesh.

    A ray from each point along +z counts the faces that it leaves and enters through. Overlapping closed
    parts count as one body.

    Args:
        mesh: watertight, oriented outwards [m].
        points: positions [m], shape (P, 3).

    Returns:
        True inside, shape (P,).
    """
    return _Columns(mesh).inside(np.asarray(points, dtype=np.float64))


def check_apart(meshes: Sequence[trimesh.Trimesh]) -> None:
    """Make sure that no two solids share space.

    Raises:
        InputError: a vertex of one lies inside another.
    """
    for (i, a), (j, b) in combinations(enumerate(meshes), 2):
        if inside(a, b.vertices).any() or inside(b, a.vertices).any():
            raise InputError(f"bodies {i} and {j} overlap at the start: move one of them (height, center)")


class _Columns:
    """Faces of a mesh, sorted into the columns of a grid over (x, y)."""

    def __init__(self, mesh: trimesh.Trimesh):
        corners = np.asarray(mesh.vertices, dtype=np.float64)[mesh.faces]
        edges_xy = corners[:, 1:, :2] - corners[:, :1, :2]
        self.doubled_area = edges_xy[:, 0, 0] * edges_xy[:, 1, 1] - edges_xy[:, 0, 1] * edges_xy[:, 1, 0]
        corners = corners[self.doubled_area != 0.0]
        self.doubled_area = self.doubled_area[self.doubled_area != 0.0]
        self.corners = corners
        low, high = corners[..., :2].min(axis=1), corners[..., :2].max(axis=1)
        self.origin = low.min(axis=0)
        extent = float((high.max(axis=0) - self.origin).max())
        # About as many columns as faces seen from above: few faces a column, few columns a face.
        self.side = int(np.clip(np.sqrt(len(corners) / 2), 1, 512))
        self.width = extent / self.side * (1 + 1e-9)
        first, last = self._column(low), self._column(high)
        spans = last - first + 1
        copies = spans.prod(axis=1)
        face = np.repeat(np.arange(len(corners)), copies)
        slot = np.arange(len(face)) - np.repeat(np.cumsum(copies) - copies, copies)
        column = first[face] + np.stack([slot // spans[face, 1], slot % spans[face, 1]], axis=1)
        key = column[:, 0] * self.side + column[:, 1]
        self.faces = face[np.argsort(key, kind="stable")]
        self.start = np.concatenate([[0], np.cumsum(np.bincount(key, minlength=self.side**2))])

    def _column(self, xy: Array) -> NDArray[np.int64]:
        return np.clip(((xy - self.origin) / self.width).astype(np.int64), 0, self.side - 1)

    def inside(self, points: Array) -> NDArray[np.bool_]:
        relative = (points[:, :2] - self.origin) / self.width
        near = np.flatnonzero(((relative >= 0) & (relative <= self.side)).all(axis=1))
        column = self._column(points[near, :2])
        key = column[:, 0] * self.side + column[:, 1]
        candidates = self.start[key + 1] - self.start[key]
        winding = np.zeros(len(points))
        chunks = np.cumsum(candidates) // _CHUNK_PAIRS
        for part in np.split(np.arange(len(near)), np.flatnonzero(np.diff(chunks)) + 1):
            count = candidates[part]
            point = np.repeat(near[part], count)
            slot = np.arange(len(point)) - np.repeat(np.cumsum(count) - count, count)
            face = self.faces[np.repeat(self.start[key[part]], count) + slot]
            winding += np.bincount(point, self._crossings(points[point], face), minlength=len(points))
        return winding > 0.5

    def _crossings(self, points: Array, face: NDArray[np.int64]) -> Array:
        """+1 where the upward ray of a point leaves through the face, -1 where it enters, 0 elsewhere.

        The side of a point with respect to an edge is computed from the edge's ends in one order for both
        faces that share it, and a point on the edge belongs to one side: exactly one of the two faces is hit.
        """
        corners = self.corners[face]
        x, y = points[:, 0], points[:, 1]
        weights = np.empty((3, len(points)))
        orientation = np.sign(self.doubled_area[face])
        hit = np.ones(len(points), dtype=bool)
        for k in range(3):
            a, b = corners[:, (k + 1) % 3, :2], corners[:, (k + 2) % 3, :2]
            swap = (a[:, 0] > b[:, 0]) | ((a[:, 0] == b[:, 0]) & (a[:, 1] > b[:, 1]))
            low, high = np.where(swap[:, None], b, a), np.where(swap[:, None], a, b)
            side = (high[:, 0] - low[:, 0]) * (y - low[:, 1]) - (high[:, 1] - low[:, 1]) * (x - low[:, 0])
            direction = np.where(swap, -1.0, 1.0) * orientation
            hit &= np.where(side >= 0, 1.0, -1.0) == direction
            weights[k] = side * direction
        total = weights.sum(axis=0)
        height = np.einsum("kp,pk->p", weights, corners[:, :, 2]) / np.where(total > 0, total, 1.0)
        return np.where(hit & (height > points[:, 2]), orientation, 0.0)


def sample_volume(
    mesh: trimesh.Trimesh, count: int, seed: int = 0, method: Literal["jittered", "uniform"] = "jittered"
) -> Array:
    """Points spread evenly over the inside of a mesh (paper, section 3.2: uniform samples of the volume).

    Args:
        mesh: watertight, oriented outwards [m].
        count: wanted number of points.
        seed: of the random generator.
        method: ``jittered`` puts one point at random into each cell of a grid (of a random origin), and keeps
            those inside; ``uniform`` draws all points independently.

    Returns:
        Points [m], shape (n, 3), with n equal to ``count`` (uniform) or within 5 % of it (jittered).

    Raises:
        InputError: a mesh without an inside, or a count that cannot be reached.
    """
    check_mesh(mesh)
    if count < 1:
        raise InputError(f"volume sampling: {count} points were asked for; ask for at least 1")
    if method not in ("jittered", "uniform"):
        raise InputError(f"volume sampling: unknown method {method!r}; choose jittered or uniform")
    rng = np.random.default_rng(seed)
    columns = _Columns(mesh)
    if method == "uniform":
        return _uniform(columns, mesh, count, rng)
    best = np.empty((0, 3))
    spacing = float(np.cbrt(mesh.volume / count))
    for _ in range(_ATTEMPTS):
        points = _jittered_grid(mesh.bounds, spacing, rng)
        points = points[columns.inside(points)]
        if abs(len(points) - count) < abs(len(best) - count):
            best = points
        if abs(len(best) - count) <= _COUNT_TOLERANCE * count:
            break
    if abs(len(best) - count) > 0.05 * count:
        raise InputError(
            f"volume sampling: {len(best)} points at best where {count} were asked for; a jittered grid "
            "cannot hit so small a count in this body, use the uniform method or more points"
        )
    return best


def sample_tracers(mesh: trimesh.Trimesh, count: int = 100_000, seed: int = 0) -> Array:
    """Dense passive points that fill a body, one in each cell of a jittered grid: `sample_volume`."""
    return sample_volume(mesh, count, seed, method="jittered")


def _jittered_grid(bounds: Array, spacing: float, rng: np.random.Generator) -> Array:
    """One random point in every cell of a grid with a random origin that covers the bounds."""
    origin = bounds[0] - spacing * rng.random(3)
    shape = np.ceil((bounds[1] - origin) / spacing).astype(int)
    cells = np.stack(np.meshgrid(*(np.arange(n) for n in shape), indexing="ij"), axis=-1).reshape(-1, 3)
    return origin + spacing * (cells + rng.random(cells.shape))


def _uniform(columns: _Columns, mesh: trimesh.Trimesh, count: int, rng: np.random.Generator) -> Array:
    """Independent points by rejection from the bounding box."""
    filled = float(mesh.volume / np.prod(mesh.extents))
    found: list[Array] = []
    while sum(map(len, found)) < count:
        tries = int((count - sum(map(len, found))) / filled * 1.05) + 16
        points = mesh.bounds[0] + rng.random((tries, 3)) * mesh.extents
        found.append(points[columns.inside(points)])
    return np.concatenate(found)[:count]


def volume_iou(a: trimesh.Trimesh, b: trimesh.Trimesh, resolution: int = 96) -> float:
    """Volume of the intersection over that of the union.

    Measured on a jittered grid with ``resolution`` cells along the longest side of the common bounding box,
    which is accurate to about 1e-3 at the default.

    Raises:
        InputError: a mesh without an inside.
    """
    check_mesh(a, "first mesh")
    check_mesh(b, "second mesh")
    bounds = np.stack([np.minimum(a.bounds[0], b.bounds[0]), np.maximum(a.bounds[1], b.bounds[1])])
    spacing = float((bounds[1] - bounds[0]).max()) / resolution
    points = _jittered_grid(bounds, spacing, np.random.default_rng(0))
    in_a, in_b = inside(a, points), inside(b, points)
    return float((in_a & in_b).sum() / (in_a | in_b).sum())
