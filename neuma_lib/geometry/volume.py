"""The inside of a closed surface: membership, evenly spread points, overlap of two bodies.

Meshes are `trimesh.Trimesh` in metres, watertight and oriented outwards; points are float64 arrays.
"""

# No `from __future__ import annotations` here: Warp reads the annotations of kernels as objects.
from collections.abc import Sequence
from itertools import combinations, product
from typing import Literal

import numpy as np
import trimesh
import warp as wp
from numpy.typing import NDArray
from scipy import ndimage

from neuma_lib.device import start_warp
from neuma_lib.errors import InputError

start_warp()

Array = NDArray[np.float64]

_ATTEMPTS = 12
"""Samplings tried for a count near the wanted one."""
_COUNT_TOLERANCE = 0.01
"""Relative error of the count at which no further sampling is tried; the promise is 5 %."""
_CELLS_A_POINT = 4
"""Cells of the grid that spares points their winding numbers."""


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

    Decided by Warp's winding numbers in single precision, on the CPU so that every machine fills a body alike. Parts
    that overlap count as one body; a point within about 1e-7 of the mesh's size of its surface may go either way.
    Between two points in a region of cells that no face comes near there is no surface: one of them decides for all.

    Args:
        mesh: watertight, oriented outwards [m].
        points: positions [m], shape (P, 3).

    Returns:
        True inside, shape (P,).
    """
    found = ((points >= mesh.bounds[0]) & (points <= mesh.bounds[1])).all(axis=1)
    near = np.flatnonzero(found)
    if len(near) == 0:
        return found
    alone, alike = np.unique(_regions(mesh, points[near]), return_index=True, return_inverse=True)[1:]
    found[near] = _winding_inside(mesh, points[near[alone]])[alike]
    return found


def _regions(mesh: trimesh.Trimesh, points: Array) -> NDArray[np.int64]:
    """Numbers (P,), the same only of points (P, 3) within the mesh's bounds that no face of it separates."""
    diagonal = float(np.linalg.norm(mesh.extents))
    wide = np.maximum(mesh.extents, 1e-3 * diagonal)  # a leaf's cells are no thinner
    cell = float((np.prod(wide) / (_CELLS_A_POINT * len(points))) ** (1 / 3))
    slack = 1e-5 * diagonal  # for what single precision moves
    origin = mesh.bounds[0] - slack
    shape = tuple(((mesh.extents + 2 * slack) / cell).astype(int) + 1)
    corners = mesh.triangles
    first = np.maximum(((corners.min(axis=1) - slack - origin) / cell).astype(int), 0)
    last = np.minimum(((corners.max(axis=1) + slack - origin) / cell).astype(int), np.array(shape) - 1) + 1
    # How many boxes of faces cover a cell: +1 and -1 at the boxes' corners, summed along each axis.
    picks, grid = list(product((0, 1), repeat=3)), tuple(np.add(shape, 1))
    at = np.concatenate([np.ravel_multi_index(np.where(pick, last, first).T, grid) for pick in picks])
    signs = np.repeat([(-1.0) ** sum(pick) for pick in picks], len(first))
    covers = np.bincount(at, signs, np.prod(grid)).reshape(grid).astype(np.int32)
    for axis in range(3):
        np.cumsum(covers, axis=axis, out=covers)
    labels, count = ndimage.label(covers[:-1, :-1, :-1] == 0)
    own = labels[tuple(((points - origin) / cell).astype(int).T)].astype(np.int64)
    close = own == 0
    own[close] = count + 1 + np.arange(close.sum())
    return own


def _winding_inside(mesh: trimesh.Trimesh, points: Array) -> NDArray[np.bool_]:
    """`inside` of points (P, 3) within the mesh's bounds, by the winding number of each."""
    centre, diagonal = mesh.bounds.mean(axis=0), float(np.linalg.norm(mesh.extents))
    body = wp.Mesh(
        wp.array(mesh.vertices - centre, dtype=wp.vec3, device="cpu"),
        wp.array(mesh.faces.ravel(), dtype=wp.int32, device="cpu"),
        support_winding_number=True,
    )
    signs = wp.empty(len(points), dtype=wp.float32, device="cpu")
    queries = wp.array(points - centre, dtype=wp.vec3, device="cpu")
    wp.launch(_winding_signs, len(points), [body.id, queries, diagonal], [signs], device="cpu")
    return signs.numpy() < 0


@wp.kernel(enable_backward=False)
def _winding_signs(
    mesh: wp.uint64,
    points: wp.array(dtype=wp.vec3),
    reach: wp.float32,  # larger than the distance of any point to the mesh
    signs: wp.array(dtype=wp.float32),  # out: -1 inside, 1 outside
):
    i = wp.tid()
    signs[i] = wp.mesh_query_point_sign_winding_number(mesh, points[i], reach).sign


def check_apart(meshes: Sequence[trimesh.Trimesh]) -> None:
    """Make sure that no two solids share space.

    Raises:
        InputError: a vertex of one lies inside another.
    """
    for (i, a), (j, b) in combinations(enumerate(meshes), 2):
        if inside(a, b.vertices).any() or inside(b, a.vertices).any():
            raise InputError(f"bodies {i} and {j} overlap at the start: move one of them (height, center)")


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
    if method == "uniform":
        return _uniform(mesh, count, rng)
    best = np.empty((0, 3))
    spacing = float(np.cbrt(mesh.volume / count))
    for _ in range(_ATTEMPTS):
        points = _jittered_grid(mesh.bounds, spacing, rng)
        points = points[inside(mesh, points)]
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


def _uniform(mesh: trimesh.Trimesh, count: int, rng: np.random.Generator) -> Array:
    """Independent points by rejection from the bounding box."""
    filled = float(mesh.volume / np.prod(mesh.extents))
    found: list[Array] = []
    while sum(map(len, found)) < count:
        tries = int((count - sum(map(len, found))) / filled * 1.05) + 16
        points = mesh.bounds[0] + rng.random((tries, 3)) * mesh.extents
        found.append(points[inside(mesh, points)])
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
