"""Procedural solids of the benchmarks: a ball, a duck, a pawn, a cat, a bottle, a fish, and letters.

Every solid is a signed distance function (negative inside), a smooth union of rounded primitives, and is meshed by
marching cubes. Primitives belong to named parts (body, beak, eyes ...), which a scene can colour. A part may also be
painted on the surface (eyes, a label) without changing the solid.

Frame: right-handed, y up, front towards +z and the frontal camera. Nominal sizes are metres at the benchmarks' scale.
Thin parts (necks, ears, tails) have about 6 cm, so that a grid of 24 cells per metre resolves them.
"""

import difflib
import re
import string
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import cache

import numpy as np
import trimesh
from scipy import ndimage
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation
from skimage import measure

from neuma_lib.errors import InputError
from neuma_lib.extras import require

Array = np.ndarray
Distance = Callable[[Array], Array]
Vector = tuple[float, float, float]


@dataclass(frozen=True)
class Shape:
    """A solid as parts with signed distances.

    Attributes:
        parts: part name -> signed distance (n,3) -> (n,) in nominal metres; the solid is their smooth union.
        blend: width of the smooth union [m].
        paint: part name -> signed distance of a region whose surface has that part's colour.
        lower, upper: nominal bounding box [m].
    """

    parts: dict[str, Distance]
    blend: float
    lower: Vector
    upper: Vector
    paint: dict[str, Distance] = field(default_factory=dict)

    @property
    def part_names(self) -> tuple[str, ...]:
        """Names of the parts that can be coloured, in the order of :meth:`part_weights`."""
        return tuple(self.parts) + tuple(name for name in self.paint if name not in self.parts)

    def distance(self, points: Array) -> Array:
        """Approximate signed distance (n,) [nominal m] of points (n,3); negative inside."""
        return union(self.blend, *self.parts.values())(points)

    def part_weights(self, points: Array, softness: float) -> Array:
        """Weights (n, parts), which sum to 1, of :attr:`part_names` at points (n,3).

        Borders between parts are ``softness`` [nominal m] wide, for antialiasing.
        """
        distances = np.stack([part(points) for part in self.parts.values()], axis=1)
        nearest = np.clip(1.0 - (distances - distances.min(axis=1, keepdims=True)) / softness, 0.0, 1.0)
        painted = len(self.part_names) - len(self.parts)
        weights = np.pad(nearest / nearest.sum(axis=1, keepdims=True), ((0, 0), (0, painted)))
        for name, region in self.paint.items():
            cover = np.clip(0.5 - region(points) / softness, 0.0, 1.0)[:, None]
            weights *= 1.0 - cover
            weights[:, self.part_names.index(name)] += cover[:, 0]
        return weights


# --- primitives: points (n,3) -> signed distance (n,) ------------------------------------------------------------


def union(width: float, *parts: Distance) -> Distance:
    """Union of parts, with seams rounded over ``width`` [m] by a polynomial smooth minimum."""

    def distance(p: Array) -> Array:
        result = parts[0](p)
        for part in parts[1:]:
            other = part(p)
            overlap = np.maximum(width - np.abs(result - other), 0.0) / max(width, 1e-12)
            result = np.minimum(result, other) - 0.25 * width * overlap**2
        return result

    return distance


def _vector(*values: float) -> Array:
    return np.asarray(values, dtype=np.float64)


def sphere(centre: Vector, radius: float) -> Distance:
    """Ball with a radius in [m]."""
    c = _vector(*centre)
    return lambda p: np.linalg.norm(p - c, axis=1) - radius


def ellipsoid(centre: Vector, radii: Vector, tilt: float = 0.0) -> Distance:
    """Ellipsoid, rotated by ``tilt`` [degrees] about z; the distance is accurate to first order near the surface."""
    c, r = _vector(*centre), _vector(*radii)
    cos, sin = np.cos(np.radians(tilt)), np.sin(np.radians(tilt))

    def distance(p: Array) -> Array:
        q = p - c
        q = np.stack([cos * q[:, 0] + sin * q[:, 1], cos * q[:, 1] - sin * q[:, 0], q[:, 2]], axis=1)
        k0 = np.linalg.norm(q / r, axis=1)
        k1 = np.linalg.norm(q / r**2, axis=1)
        return np.where(k1 > 1e-12, k0 * (k0 - 1.0) / np.maximum(k1, 1e-12), -r.min())

    return distance


def tapered_capsule(start: Vector, stop: Vector, r_start: float, r_stop: float) -> Distance:
    """Capsule with a radius that changes linearly from one end to the other [m]."""
    a, b = _vector(*start), _vector(*stop)
    axis = b - a

    def distance(p: Array) -> Array:
        t = np.clip((p - a) @ axis / (axis @ axis), 0.0, 1.0)
        return np.linalg.norm(p - a - t[:, None] * axis, axis=1) - (r_start + (r_stop - r_start) * t)

    return distance


def revolved(profile: Distance) -> Distance:
    """Solid of revolution about the vertical axis from a 2-D distance over (radius, y)."""
    return lambda p: profile(np.stack([np.hypot(p[:, 0], p[:, 2]), p[:, 1]], axis=1))


def polygon(corners: list[tuple[float, float]], rounding: float = 0.0) -> Distance:
    """Exact signed distance to a closed 2-D polygon, with corners rounded outwards by ``rounding`` [m]."""
    a = np.asarray(corners, dtype=np.float64)
    b = np.roll(a, -1, axis=0)

    def distance(p: Array) -> Array:
        best = np.full(len(p), np.inf)
        odd = np.zeros(len(p), dtype=bool)
        for s, e in zip(a, b, strict=True):
            edge = e - s
            t = np.clip((p - s) @ edge / (edge @ edge), 0.0, 1.0)
            best = np.minimum(best, np.linalg.norm(p - s - t[:, None] * edge, axis=1))
            crosses = (s[1] > p[:, 1]) != (e[1] > p[:, 1])
            if edge[1] != 0.0:
                odd ^= crosses & (p[:, 0] < s[0] + (p[:, 1] - s[1]) / edge[1] * edge[0])
        return np.where(odd, -best, best) - rounding

    return distance


def cylinder(radius: float, bottom: float, top: float, rounding: float) -> Distance:
    """Upright cylinder on the vertical axis, enlarged by ``rounding`` [m] on all sides with rounded edges."""
    return revolved(polygon([(0, bottom), (radius, bottom), (radius, top), (0, top)], rounding))


def extruded(profile: Distance, half_depth: float, rounding: float) -> Distance:
    """Extrusion along z of a 2-D distance over (x, y), with rounded edges; total depth 2 ``half_depth`` [m]."""

    def distance(p: Array) -> Array:
        d = profile(p[:, :2]) + rounding
        w = np.abs(p[:, 2]) - half_depth + rounding
        outside = np.hypot(np.maximum(d, 0.0), np.maximum(w, 0.0))
        return np.minimum(np.maximum(d, w), 0.0) + outside - rounding

    return distance


def mirrored(part: Distance, axis: int) -> Distance:
    """The part, given for coordinates >= 0 along an axis, and its mirror image in the plane at 0."""
    return lambda p: part(np.abs(p, where=np.arange(3) == axis, out=p.copy()))


def turned(part: Distance, degrees: float) -> Distance:
    """The part rotated about the vertical axis, counter-clockwise seen from above."""
    cos, sin = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    return lambda p: part(
        np.stack([cos * p[:, 0] - sin * p[:, 2], p[:, 1], sin * p[:, 0] + cos * p[:, 2]], axis=1)
    )


# --- the solids --------------------------------------------------------------------------------------------------


def _ball() -> Shape:
    """A beach ball: six painted panels between two caps; its axis leans towards the camera."""
    axis = _vector(0.25, 0.85, 0.46)
    axis /= np.linalg.norm(axis)
    east = np.cross(axis, _vector(0.0, 0.0, 1.0))
    east /= np.linalg.norm(east)
    north = np.cross(axis, east)

    def panel(k: int) -> Distance:
        def distance(p: Array) -> Array:
            angle = np.arctan2(p @ north, p @ east) - (k + 0.5) * np.pi / 3
            angle = np.abs((angle + np.pi) % (2 * np.pi) - np.pi)
            return 0.13 * (angle - np.pi / 6)

        return distance

    def caps(p: Array) -> Array:
        # division by the slope of the difference at its zero gives metres
        return (0.93 * np.linalg.norm(p, axis=1) - np.abs(p @ axis)) / np.sqrt(1.0 - 0.93**2)

    return Shape(
        parts={"body": sphere((0, 0, 0), 0.13)},
        blend=0.0,
        lower=(-0.14,) * 3,
        upper=(0.14,) * 3,
        paint={
            "second": union(0.0, panel(0), panel(3)),
            "third": union(0.0, panel(1), panel(4)),
            "caps": caps,
        },
    )


def _duck() -> Shape:
    """A bath duck that looks to the right, rotated slightly towards the camera."""
    turn = 28.0
    body = union(
        0.05,
        ellipsoid((-0.015, 0.0, 0.0), (0.165, 0.105, 0.120)),
        tapered_capsule((-0.10, 0.02, 0.0), (-0.185, 0.105, 0.0), 0.075, 0.032),
        tapered_capsule((0.06, 0.05, 0.0), (0.075, 0.16, 0.0), 0.085, 0.07),
    )
    wing = mirrored(ellipsoid((-0.035, 0.02, 0.105), (0.085, 0.052, 0.032), tilt=-14.0), 2)
    head = sphere((0.085, 0.185, 0.0), 0.092)
    beak = union(
        0.02,
        ellipsoid((0.185, 0.172, 0.0), (0.052, 0.024, 0.048), tilt=8.0),
        ellipsoid((0.172, 0.152, 0.0), (0.042, 0.020, 0.040), tilt=-6.0),
    )
    eye = mirrored(sphere((0.135, 0.215, 0.070), 0.0235), 2)
    parts = {"body": union(0.03, body, head), "wing": wing, "beak": beak}
    return Shape(
        parts={name: turned(part, -turn) for name, part in parts.items()},
        blend=0.018,
        lower=(-0.27, -0.13, -0.24),
        upper=(0.27, 0.31, 0.24),
        paint={"eye": turned(eye, -turn)},
    )


def _pawn() -> Shape:
    """A chess pawn: foot, waist, collar and head, turned on a lathe."""
    foot = cylinder(0.118, 0.012, 0.045, rounding=0.012)
    step = cylinder(0.092, 0.05, 0.075, rounding=0.012)
    waist = polygon([(0, 0.06), (0.082, 0.08), (0.058, 0.13), (0.046, 0.19), (0.044, 0.26), (0, 0.26)], 0.006)
    collar = cylinder(0.074, 0.248, 0.262, rounding=0.014)
    return Shape(
        parts={
            "body": union(0.03, step, revolved(waist), sphere((0, 0.335, 0), 0.082)),
            "foot": foot,
            "collar": collar,
        },
        blend=0.012,
        lower=(-0.14, -0.01, -0.14),
        upper=(0.14, 0.43, 0.14),
    )


def _cat() -> Shape:
    """A sitting cat, its face to the camera, the tail around its side."""
    body = union(
        0.05,
        ellipsoid((0, 0.085, -0.02), (0.098, 0.088, 0.098)),
        tapered_capsule((0, 0.07, -0.01), (0, 0.185, 0.015), 0.090, 0.060),
    )
    legs = mirrored(tapered_capsule((0.042, 0.14, 0.055), (0.045, 0.032, 0.085), 0.034, 0.032), 0)
    thighs = mirrored(ellipsoid((0.088, 0.055, 0.015), (0.042, 0.056, 0.072)), 0)
    head = ellipsoid((0, 0.232, 0.035), (0.096, 0.076, 0.076))
    muzzle = mirrored(sphere((0.020, 0.208, 0.098), 0.029), 0)
    ears = mirrored(tapered_capsule((0.058, 0.272, 0.030), (0.079, 0.338, 0.026), 0.040, 0.013), 0)
    spine = (0.05, 0.035, -0.085), (0.145, 0.035, -0.045), (0.163, 0.060, 0.03), (0.152, 0.125, 0.065)
    tail = union(0.02, *map(tapered_capsule, spine, spine[1:], (0.032, 0.031, 0.030), (0.031, 0.030, 0.028)))
    inner_ear = mirrored(ellipsoid((0.066, 0.300, 0.060), (0.020, 0.034, 0.034)), 0)
    eyes = mirrored(ellipsoid((0.038, 0.243, 0.105), (0.017, 0.020, 0.024)), 0)
    nose = ellipsoid((0, 0.222, 0.128), (0.014, 0.010, 0.014))

    def stripes(p: Array) -> Array:
        on_body = np.where(p[:, 1] < 0.172, np.abs(((p[:, 1] + 0.35 * p[:, 2]) % 0.058) - 0.029) - 0.010, 1.0)
        back_only = p[:, 2] - 0.045
        forehead = np.where(p[:, 1] > 0.265, np.abs((np.abs(p[:, 0]) + 0.013) % 0.026 - 0.013) - 0.006, 1.0)
        forehead = np.maximum(forehead, np.abs(p[:, 0]) - 0.03)
        return np.minimum(np.maximum(on_body, back_only), forehead)

    def tail_tip(p: Array) -> Array:
        return np.where((tail(p) < 0.01) & (p[:, 0] > 0.1), 0.098 - p[:, 1], 1.0)

    white = union(0.0, muzzle, ellipsoid((0, 0.135, 0.08), (0.036, 0.05, 0.05)))
    paws = mirrored(sphere((0.045, 0.022, 0.09), 0.045), 0)
    return Shape(
        parts={
            "body": union(0.018, union(0.03, body, legs, head, ears), muzzle),
            "thighs": thighs,
            "tail": tail,
        },
        blend=0.018,
        lower=(-0.15, -0.02, -0.14),
        upper=(0.21, 0.37, 0.16),
        paint={
            "stripes": stripes,
            "white": union(0.0, lambda p: white(p) - 0.004, paws, tail_tip),
            "inner_ear": inner_ear,
            "eyes": eyes,
            "nose": nose,
        },
    )


def _bottle() -> Shape:
    """A honey bottle: a round body with a label, shoulders, a neck and a cap."""
    body = polygon(
        [(0, 0.02), (0.090, 0.02), (0.098, 0.05), (0.098, 0.215), (0.075, 0.265), (0.045, 0.30), (0, 0.30)],
        0.016,
    )
    neck = cylinder(0.042, 0.28, 0.37, 0.010)
    cap = cylinder(0.056, 0.375, 0.430, 0.012)

    def label(p: Array) -> Array:
        return np.abs(p[:, 1] - 0.135) - 0.062

    def emblem(p: Array) -> Array:
        hexagon = np.maximum(np.abs(p[:, 1] - 0.135), 0.866 * np.abs(p[:, 0]) + 0.5 * np.abs(p[:, 1] - 0.135))
        return np.where(np.abs(p[:, 2]) > 0.05, hexagon - 0.040, 1.0)

    return Shape(
        parts={"body": union(0.02, revolved(body), neck), "cap": cap},
        blend=0.008,
        lower=(-0.13, -0.01, -0.13),
        upper=(0.13, 0.46, 0.13),
        paint={"label": label, "emblem": emblem},
    )


def _fish() -> Shape:
    """A fish that swims to the right, seen from its side."""
    body = ellipsoid((0.03, 0, 0), (0.155, 0.098, 0.075))
    stalk = tapered_capsule((-0.08, 0, 0), (-0.15, 0, 0), 0.055, 0.036)
    tail_fin = polygon(
        [(-0.135, -0.012), (-0.195, -0.085), (-0.175, 0.0), (-0.195, 0.085), (-0.135, 0.012)], 0.022
    )
    dorsal = polygon([(-0.055, 0.06), (-0.055, 0.115), (0.0, 0.118), (0.075, 0.07)], 0.018)
    belly = polygon([(-0.02, -0.06), (-0.05, -0.115), (-0.01, -0.112), (0.04, -0.07)], 0.016)
    fins = extruded(tail_fin, 0.031, 0.022), extruded(dorsal, 0.029, 0.02), extruded(belly, 0.029, 0.02)
    side_fin = mirrored(tapered_capsule((0.06, -0.025, 0.060), (0.0, -0.050, 0.092), 0.032, 0.024), 2)
    eye = mirrored(sphere((0.128, 0.030, 0.052), 0.026), 2)
    pupil = mirrored(sphere((0.134, 0.030, 0.060), 0.0165), 2)
    mouth = mirrored(ellipsoid((0.178, -0.026, 0.0), (0.030, 0.007, 0.06), tilt=12.0), 2)

    def stripes(p: Array) -> Array:
        wave = p[:, 0] - 0.9 * p[:, 1] ** 2 / 0.1
        on_body = np.minimum(np.abs(wave - 0.058) - 0.017, np.abs(wave + 0.042) - 0.017)
        return np.where(np.maximum(body(p), -0.2) < 0.008, on_body, 1.0)

    return Shape(
        parts={"body": union(0.04, body, stalk), "fins": union(0.01, *fins), "side_fins": side_fin},
        blend=0.02,
        lower=(-0.25, -0.17, -0.14),
        upper=(0.21, 0.17, 0.14),
        paint={"stripes": stripes, "eye": eye, "pupil": pupil, "mouth": mouth},
    )


def _letter(character: str) -> Shape:
    """A capital letter as a rounded block, from the outline of the bold font that comes with matplotlib."""
    bold = require("matplotlib.font_manager", "workflow").FontProperties(family="DejaVu Sans", weight="bold")
    outline = require("matplotlib.textpath", "workflow").TextPath((0, 0), character, size=1.0, prop=bold)
    box = outline.get_extents()
    cell, margin = 0.004, 0.15
    xs = np.arange(box.x0 - margin, box.x1 + margin, cell)
    ys = np.arange(box.y0 - margin, box.y1 + margin, cell)
    grid = np.stack(np.meshgrid(xs, ys, indexing="ij"), axis=-1).reshape(-1, 2)
    # even-odd rule, because holes are loops inside the outline
    filled = np.zeros(len(grid), dtype=bool)
    for loop in outline.to_polygons():
        filled ^= measure.points_in_poly(grid, loop)
    filled = filled.reshape(len(xs), len(ys))
    signed = (ndimage.distance_transform_edt(~filled) - ndimage.distance_transform_edt(filled)) * cell
    signed = ndimage.gaussian_filter(signed, 2.0)
    scale = 0.3 / (box.y1 - box.y0)
    middle = _vector((box.x0 + box.x1) / 2, (box.y0 + box.y1) / 2)

    def profile(q: Array) -> Array:
        index = (q / scale + middle - _vector(xs[0], ys[0])) / cell
        return scale * ndimage.map_coordinates(signed, index.T, order=1, mode="nearest")

    half_width = scale * (box.x1 - box.x0) / 2 + 0.02
    return Shape(
        parts={"body": extruded(profile, half_depth=0.045, rounding=0.014)},
        blend=0.0,
        lower=(-half_width, -0.17, -0.065),
        upper=(half_width, 0.17, 0.065),
    )


_MAKERS = {"ball": _ball, "duck": _duck, "pawn": _pawn, "cat": _cat, "bottle": _bottle, "fish": _fish}
NAMES = tuple(_MAKERS)  # named solids, in addition to ``letter_A`` ... ``letter_Z``.


@cache
def shape(name: str) -> Shape:
    """The solid with a name. Raises InputError, which lists the known names, for others."""
    if name in _MAKERS:
        return _MAKERS[name]()
    if re.fullmatch(r"letter_[A-Z]", name):
        return _letter(name[-1])
    near = difflib.get_close_matches(name, [*NAMES, *(f"letter_{c}" for c in string.ascii_uppercase)], n=1)
    hint = f"; did you mean {near[0]!r}?" if near else ""
    remedy = f"Choose one of {', '.join(NAMES)} or letter_A ... letter_Z"
    raise InputError("shape", f"{name!r} is unknown{hint}", remedy)


def build(name: str | trimesh.Trimesh, size: float | None = None, resolution: int = 96) -> trimesh.Trimesh:
    """Mesh a solid.

    Args:
        name: one of :data:`NAMES` or ``letter_A`` ... ``letter_Z``; or the closed mesh of another solid [m], whose only
            part is ``body``.
        size: longest side of the bounding box [m]; None keeps the nominal size.
        resolution: cells along the longest side.

    Returns:
        A watertight mesh [m], faces outward, its bounding box centred at the origin, with metadata for
        :func:`to_nominal`.

    Raises:
        InputError: unknown name, or a size or resolution that is not positive.
    """
    solid = shape(name) if isinstance(name, str) else _of_mesh(name)
    label = name if isinstance(name, str) else "mesh"
    if resolution < 8:
        raise InputError("resolution", f"must be at least 8 for shape {label!r}, not {resolution}")
    if size is not None and not size > 0.0:
        raise InputError("size", f"must be a positive length in metres for shape {label!r}, not {size}")
    mesh = name
    if isinstance(name, str):
        mesh = max(meshed(solid, resolution), key=lambda body: abs(body.volume))
    nominal = mesh.vertices.copy()
    centre = mesh.bounds.mean(axis=0)
    scale = 1.0 if size is None else size / np.ptp(nominal, axis=0).max()
    result = trimesh.Trimesh((nominal - centre) * scale, mesh.faces, process=False)
    result.metadata.update(shape=label, solid=solid, scale=float(scale), centre=centre.tolist())
    return result


def meshed(solid: Shape, resolution: int) -> list[trimesh.Trimesh]:
    """Surfaces of the bodies and cavities of a solid, in nominal metres, with ``resolution`` cells a longest side."""
    lower, upper = _vector(*solid.lower), _vector(*solid.upper)
    cell = (upper - lower).max() / resolution
    axes = [np.arange(lo - 1.5 * cell, hi + 1.5 * cell, cell) for lo, hi in zip(lower, upper, strict=True)]
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
    values = solid.distance(grid.reshape(-1, 3)).reshape(grid.shape[:3])
    # a value of exactly zero would give degenerate triangles
    values[np.abs(values) < 1e-7] = 1e-7
    vertices, faces, _, _ = measure.marching_cubes(
        values, 0.0, spacing=(cell,) * 3, gradient_direction="descent", allow_degenerate=False
    )
    vertices = vertices.astype(np.float64) + _vector(*(axis[0] for axis in axes))
    return trimesh.Trimesh(vertices, faces, process=True).split(only_watertight=False)


def _of_mesh(mesh: trimesh.Trimesh) -> Shape:
    """The solid in a closed mesh with small triangles; its distance is that to the plane of the nearest vertex."""
    vertices, normals, tree = mesh.vertices, mesh.vertex_normals, cKDTree(mesh.vertices)

    def distance(p: Array) -> Array:
        nearest = tree.query(p)[1]
        return np.einsum("ij,ij->i", p - vertices[nearest], normals[nearest])

    return Shape({"body": distance}, 0.0, *mesh.bounds.tolist())


def place(
    name: str | trimesh.Trimesh,
    size: float | None,
    height: float,
    center: Sequence[float],
    resolution: int = 96,
    rotation: Sequence[float] = (0.0, 0.0, 0.0),
) -> trimesh.Trimesh:
    """The solid at its initial position in a scene.

    Args:
        name, size, resolution: see :func:`build`.
        height: y of the bounding box's centre [m].
        center: x and z of the bounding box's centre [m].
        rotation: rotation vector of the solid [rad]. Its size is that before the rotation.
    """
    mesh = build(name, size, resolution)
    if any(rotation):
        R = Rotation.from_rotvec(rotation).as_matrix()
        turned = mesh.vertices @ R.T
        shift = (turned.min(axis=0) + turned.max(axis=0)) / 2
        mesh.vertices = turned - shift
        mesh.metadata.update(rotation=R.tolist(), shift=shift.tolist())
    mesh.apply_translation([center[0], height, center[1]])
    return mesh


def to_nominal(mesh: trimesh.Trimesh, points: Array) -> tuple[Shape, Array]:
    """The solid of a mesh from :func:`build`, and points (n,3) [m] transformed to its nominal frame.

    The mesh may have been translated since, and rotated by :func:`place`. Points are in its current frame.

    Raises:
        InputError: the mesh was not created by :func:`build`.
    """
    if "solid" not in mesh.metadata:
        raise InputError("mesh", "was not created by geometry.shapes.build, so its parts are unknown")
    local = np.asarray(points, dtype=np.float64) - mesh.bounds.mean(axis=0)
    if "rotation" in mesh.metadata:
        local = (local + mesh.metadata["shift"]) @ np.array(mesh.metadata["rotation"])
    return mesh.metadata["solid"], local / mesh.metadata["scale"] + np.asarray(mesh.metadata["centre"])


def depth(mesh: trimesh.Trimesh, points: Array) -> Array:
    """Approximate depth (n,) [m] of points (n,3) [m] below the surface of a mesh from :func:`build`."""
    solid, nominal = to_nominal(mesh, points)
    return -solid.distance(nominal) * mesh.metadata["scale"]
