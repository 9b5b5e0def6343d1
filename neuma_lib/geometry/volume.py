"""The inside of a closed surface: membership, sampling, overlap of two bodies.

Meshes are `trimesh.Trimesh` in metres, watertight and oriented outwards. Points are float64 arrays.
"""

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

_ATTEMPTS = 12  # maximum number of draws to reach the requested count
_COUNT_TOLERANCE = 0.01  # relative error of the count at which the attempts stop; the guaranteed error is 5 %
_CELLS_PER_POINT = 4  # cells per point of the grid that reduces the number of evaluated winding numbers
_MAX_CELLS = 20_000_000
"""Maximum number of cells, or of independent points, in the bounding box of a sampled body: about 2 GB."""


def check_mesh(mesh: trimesh.Trimesh, name: str = "mesh") -> None:
    """Check that a mesh is closed and oriented outwards.

    Raises:
        InputError: no faces, vertices that are not finite, holes, or faces that point inwards.
    """
    if len(mesh.faces) == 0:
        raise InputError(name, "has no faces")
    finite = np.isfinite(mesh.vertices).all(axis=1)
    if not finite.all():
        raise InputError(name, f"vertex {int(np.argmin(finite))} is not finite", "Export the mesh again")
    if not mesh.is_watertight:
        remedy = "Close its holes, for example with trimesh.repair.fill_holes or a voxel remesh"
        raise InputError(name, "is not watertight", remedy)
    if mesh.volume <= 0:
        raise InputError(name, "has no positive volume because its faces point inwards", "Flip them")


def inside(mesh: trimesh.Trimesh, points: Array) -> NDArray[np.bool_]:
    """Which points lie inside a closed mesh.

    Uses Warp's winding numbers in single precision, on the CPU for the same result on every machine. Overlapping parts
    are one body. Points within about 1e-7 of the mesh's size from its surface may be on either side. Points in a
    connected region of cells without faces are on the same side, so one of them is evaluated for all.

    Args:
        mesh: watertight, oriented outwards [m].
        points: positions [m], shape (P, 3).

    Returns:
        True inside, shape (P,).
    """
    result = ((points >= mesh.bounds[0]) & (points <= mesh.bounds[1])).all(axis=1)
    near = np.flatnonzero(result)
    if len(near) == 0:
        return result
    first, region = np.unique(_regions(mesh, points[near]), return_index=True, return_inverse=True)[1:]
    result[near] = _winding_inside(mesh, points[near[first]])[region]
    return result


def _regions(mesh: trimesh.Trimesh, points: Array) -> NDArray[np.int64]:
    """Labels (P,) of points (P, 3) within the mesh's bounds; points with the same label are not separated by a face."""
    diagonal = float(np.linalg.norm(mesh.extents))
    extents = np.maximum(mesh.extents, 1e-3 * diagonal)  # minimum cell size for flat meshes
    cell = float((np.prod(extents) / (_CELLS_PER_POINT * len(points))) ** (1 / 3))
    slack = 1e-5 * diagonal  # for round-off in single precision
    origin = mesh.bounds[0] - slack
    shape = tuple(((mesh.extents + 2 * slack) / cell).astype(int) + 1)
    corners = mesh.triangles
    first = np.maximum(((corners.min(axis=1) - slack - origin) / cell).astype(int), 0)
    last = np.minimum(((corners.max(axis=1) + slack - origin) / cell).astype(int), np.array(shape) - 1) + 1
    # number of bounding boxes of faces that cover a cell: +1 and -1 at the corners of the boxes, summed along each axis
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


def signed_distance(mesh: trimesh.Trimesh, points: Array) -> Array:
    """Distances [m] of points (P, 3) [m] to the faces of a mesh, negative inside, shape (P,).

    Inside is where the winding number exceeds 1/2, also for a mesh with holes or overlapping parts.
    """
    signs, distances = _nearest_faces(
        mesh, points, reach=float(np.ptp([*mesh.bounds, *points], axis=0).sum())
    )
    return signs * distances.astype(np.float64)


def _winding_inside(mesh: trimesh.Trimesh, points: Array) -> NDArray[np.bool_]:
    """`inside` for points (P, 3) within the mesh's bounds, by the winding number of each."""
    return _nearest_faces(mesh, points, reach=float(np.linalg.norm(mesh.extents)))[0] < 0


def _nearest_faces(mesh: trimesh.Trimesh, points: Array, reach: float) -> tuple[NDArray, NDArray]:
    """Side (P,), -1 inside and 1 outside, and distance (P,) [m] of points (P, 3), which is less than ``reach``."""
    centre = mesh.bounds.mean(axis=0)
    body = wp.Mesh(
        wp.array(mesh.vertices - centre, dtype=wp.vec3, device="cpu"),
        wp.array(mesh.faces.ravel(), dtype=wp.int32, device="cpu"),
        support_winding_number=True,
    )
    signs, distances = (wp.empty(len(points), dtype=wp.float32, device="cpu") for _ in range(2))
    queries = wp.array(points - centre, dtype=wp.vec3, device="cpu")
    wp.launch(_winding_signs, len(points), [body.id, queries, reach], [signs, distances], device="cpu")
    return signs.numpy(), distances.numpy()


@wp.kernel(enable_backward=False)
def _winding_signs(
    mesh: wp.uint64,
    points: wp.array(dtype=wp.vec3),
    reach: wp.float32,  # larger than the distance of any point to the mesh
    signs: wp.array(dtype=wp.float32),  # out: -1 inside, 1 outside
    distances: wp.array(dtype=wp.float32),  # out: to the nearest face
):
    i = wp.tid()
    query = wp.mesh_query_point_sign_winding_number(mesh, points[i], reach)
    signs[i] = query.sign
    distances[i] = wp.length(points[i] - wp.mesh_eval_position(mesh, query.face, query.u, query.v))


def check_apart(meshes: Sequence[trimesh.Trimesh]) -> None:
    """Check that no two solids overlap.

    Raises:
        InputError: a vertex of one lies inside another.
    """
    for (i, a), (j, b) in combinations(enumerate(meshes), 2):
        if inside(a, b.vertices).any() or inside(b, a.vertices).any():
            raise InputError(f"bodies {i} and {j}", "overlap at the start", "Change height or center")


def sample_volume(
    mesh: trimesh.Trimesh, count: int, seed: int = 0, method: Literal["jittered", "uniform"] = "jittered"
) -> Array:
    """Uniform samples of the volume of a mesh (paper, section 3.2).

    Args:
        mesh: watertight, oriented outwards [m].
        count: requested number of points.
        seed: of the random generator.
        method: ``jittered`` draws one point in each cell of a grid with a random origin and keeps those inside;
            ``uniform`` draws all points independently.

    Returns:
        Points [m], shape (n, 3), with n equal to ``count`` (uniform) or within 5 % of it (jittered).

    Raises:
        InputError: see `check_mesh`; a count that cannot be reached; a body too thin for its bounding box.
    """
    check_mesh(mesh)
    if count < 1:
        raise InputError("sample_volume: count", f"must be at least 1, not {count}")
    if method not in ("jittered", "uniform"):
        raise InputError("sample_volume: method", f"must be jittered or uniform, not {method!r}")
    spacing, filled = float(np.cbrt(mesh.volume / count)), float(mesh.volume / np.prod(mesh.extents))
    with np.errstate(divide="ignore"):
        cells = count / filled if method == "uniform" else float(np.prod(mesh.extents / spacing + 2))
    if not cells <= _MAX_CELLS:
        raise InputError(
            "sample_volume: mesh",
            f"fills {filled:.2g} of its bounding box, so that {count} points inside need {cells:.3g} cells, more than "
            f"{_MAX_CELLS:,}",
            "Use a thicker body, or fewer particles and tracers",
        )
    rng = np.random.default_rng(seed)
    if method == "uniform":
        return _uniform(mesh, count, rng)
    best = np.empty((0, 3))
    for _ in range(_ATTEMPTS):
        points = _jittered_grid(mesh.bounds, spacing, rng)
        points = points[inside(mesh, points)]
        if abs(len(points) - count) < abs(len(best) - count):
            best = points
        if abs(len(best) - count) <= _COUNT_TOLERANCE * count:
            break
    if abs(len(best) - count) > 0.05 * count:
        problem = (
            f"a jittered grid of about {count} points is impossible in this body, the nearest has {len(best)}"
        )
        raise InputError("sample_volume: count", problem, "Use the uniform method or more points")
    return best


def sample_tracers(mesh: trimesh.Trimesh, count: int = 100_000, seed: int = 0) -> Array:
    """Dense passive points that fill a body, on a jittered grid (`sample_volume`)."""
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
    accepted: list[Array] = []
    while sum(map(len, accepted)) < count:
        tries = int((count - sum(map(len, accepted))) / filled * 1.05) + 16
        points = mesh.bounds[0] + rng.random((tries, 3)) * mesh.extents
        accepted.append(points[inside(mesh, points)])
    return np.concatenate(accepted)[:count]


def volume_iou(a: trimesh.Trimesh, b: trimesh.Trimesh, resolution: int = 96) -> float:
    """Volume of the intersection over that of the union.

    Computed on a jittered grid with ``resolution`` cells along the longest side of the common bounding box, with an
    error of about 1e-3 at the default.

    Raises:
        InputError: see `check_mesh`.
    """
    check_mesh(a, "first mesh")
    check_mesh(b, "second mesh")
    bounds = np.stack([np.minimum(a.bounds[0], b.bounds[0]), np.maximum(a.bounds[1], b.bounds[1])])
    spacing = float((bounds[1] - bounds[0]).max()) / resolution
    points = _jittered_grid(bounds, spacing, np.random.default_rng(0))
    in_a, in_b = inside(a, points), inside(b, points)
    return float((in_a & in_b).sum() / (in_a | in_b).sum())
