"""Fit the specific stiffness of a clamped body to a photograph of it at rest under gravity.

Sag depends on the ratio of stiffness to density only, so that the unknown is mu / rho [m^2/s^2]. Other unknowns are
the pose of the camera, which one marker of the size of a stamp does not determine, and the placement of the body next
to the marker, with a prior. Residuals are the corners of the marker and the distances from points of the observed
silhouette to the outline of the body in equilibrium. Their derivatives are exact: by the stiffness through the implicit
function theorem, and by all unknowns at a fixed nearest point of the outline, since the nearest point moves along the
outline.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import binary_dilation
from scipy.spatial.transform import Rotation
from skimage.measure import find_contours

from neuma_lib.errors import InputError, NonFiniteError
from neuma_lib.fitting.least_squares import Linearisation, levenberg_marquardt
from neuma_lib.geometry.outline import Outline, outline, silhouette
from neuma_lib.io.datasets.stills import Still
from neuma_lib.mechanics.law import Law
from neuma_lib.sim.clamps import Clamp
from neuma_lib.sim.equilibrium import Equilibrium, clamped_nodes, solve_equilibrium
from neuma_lib.sim.hexahedra import Hexahedra

Array = NDArray[np.float64]
GRAVITY = 9.81
"""[m/s^2]"""
ROTATION, TRANSLATION, PLACEMENT = slice(0, 3), slice(3, 6), slice(6, 9)
RATIO, HELD, RELEASE, RETARDATION = range(9, 13)
CENTRE = slice(13, 15)
"""Unknowns: changes of the camera's pose and of the placement, of log(mu / rho), of the share of the weight that is
held, of the time of release, of the logarithm of the retardation time, and of the principal point of a second camera.
"""
UNKNOWNS = 15
_SCALES = np.array(
    [0.1] * 3 + [0.01] * 3 + [1.0] * 3 + [0.1, 0.03, 5e-3, 0.3, 5.0, 5.0]
)  # rad, m, (prior), 1, 1, s, 1, px
_SHAPE = slice(9, 13)
_OF_LOGARITHM = np.array([True, False, False, True])  # numbers of the shape
# standard deviation [px] and length [px] over which residuals persist
_CONTOUR_NOISE, _CORRELATED = 2.0, 30.0
_MARKER_NOISE = 0.5  # px
_ROBUST = 4.0  # residual beyond which the cost grows linearly [px]
_SPACING = 3.0  # of points of the observed silhouette [px]
_HIDDEN_MARGIN = 4  # px around hidden parts, in which the silhouette is that of what hides them
_UNKNOWN_MARGIN = 2  # px around unknown pixels, next to which a contour is theirs
_MIN_CONTOUR, _MIN_POINTS = 40, 4  # points of a contour of a visible part, and of all
_ROUNDS = 4  # after each of which points near hidden parts are chosen again
_MAX_STEP = 3.0


def contours(mask: NDArray[np.bool_]) -> list[Array]:
    """Closed contours of a mask (H, W) with holes, shape (n, 2) each [px], pixel centres at half integers."""
    lines = find_contours(np.pad(mask, 1).astype(float), 0.5)
    return [line[:, ::-1] - 0.5 for line in lines]  # padding, and half a pixel


def contour(mask: NDArray[np.bool_], unknown: NDArray[np.bool_] | None = None) -> Array:
    """Points of the longest contour of a mask (H, W) at equal distances, shape (C, 2) [px].

    Args:
        unknown: pixels (H, W) that may show the body. The contours of all visible parts of the body are then used,
            where they are not next to such pixels.

    Raises:
        InputError: there is no contour.
    """
    lines = contours(mask)
    if not lines:
        raise InputError("mask", "shows no body")
    lines = [max(lines, key=len)] if unknown is None else [line for line in lines if len(line) > _MIN_CONTOUR]
    parts = []
    for line in lines:
        reached = np.concatenate([[0], np.linalg.norm(np.diff(line, axis=0), axis=1).cumsum()])
        count = max(4, round(reached[-1] / _SPACING))
        sites = np.arange(count) * reached[-1] / count
        parts.append(np.stack([np.interp(sites, reached, line[:, axis]) for axis in (0, 1)], axis=1))
    points = np.concatenate(parts) if parts else np.empty((0, 2))
    if unknown is not None:
        near = np.asarray(binary_dilation(unknown, iterations=_UNKNOWN_MARGIN), dtype=bool)
        points = points[~_sampled(near, points)]
    if len(points) < _MIN_POINTS:
        raise InputError("mask", f"has {len(points)} points of a contour of the body, at least {_MIN_POINTS}")
    return points


def _sampled(mask: NDArray[np.bool_], points: Array) -> NDArray[np.bool_]:
    """Values (C,) of a mask (H, W) at points (C, 2) [px], those of its border outside."""
    columns, rows = np.floor(points).astype(int).T
    return mask[rows.clip(0, len(mask) - 1), columns.clip(0, mask.shape[1] - 1)]


class ClampedBody(Protocol):
    """A body whose surface depends on four numbers: mu / rho [m^2/s^2], the share of its weight that is held before a
    release, the time of the release [s], and its retardation time, viscosity / mu [s]."""

    @property
    def triangles(self) -> NDArray[np.int64]:
        """Points of the triangles of the surface (T, 3)."""
        ...

    @property
    def rotation(self) -> Array:
        """From the body's frame to the marker's, shape (3, 3)."""
        ...

    @property
    def hidden_points(self) -> NDArray[np.bool_]:
        """Points of the surface that other objects hide (P,)."""
        ...

    def positions(self, shape: Array) -> Array:
        """Points of the surface (P, 3) [m] in the body's frame."""
        ...

    def derivatives(self, shape: Array, free: Sequence[int]) -> Array:
        """Their derivatives by log(mu / rho), share, time and logarithm of the retardation time (4, P, 3). Those by
        others than ``free`` may be 0."""
        ...


@dataclass(eq=False)
class RestingBody:
    """A clamped body whose equilibrium depends on mu / rho, and on the force that holds it.

    Attributes:
        body: the undeformed body in its own frame.
        law: its elasticity. Only ratios of its moduli matter.
        shear_modulus: of the law at small strains [Pa].
        clamps: regions of the undeformed body that are held.
        rotation: from the body's frame to the marker's, shape (3, 3). Gravity is along -y of the marker's.
        hidden: box of the undeformed body behind another object, two corners, shape (2, 3) [m].
        surface_size: edge of the triangles of its surface [m].
        held: box of the undeformed body with nodes that a force against gravity pulls, by their volumes, two corners,
            shape (2, 3) [m]. Its unit is the weight of the part that is not clamped. None: nothing holds the body.
    """

    body: Hexahedra
    law: Law
    shear_modulus: float
    clamps: Sequence[Clamp]
    rotation: Array
    hidden: Array
    surface_size: float
    held: Array | None = None
    _solved: dict[tuple[float, float], Equilibrium] = field(default_factory=dict)

    def __post_init__(self):
        self.weights, self.triangles = self.body.surface(self.surface_size)
        self.undeformed = self.weights @ self.body.nodes
        low, high = self.hidden
        self.hidden_points = ((self.undeformed >= low) & (self.undeformed <= high)).all(axis=1)

    def at_rest(self, ratio: float, share: float = 0.0) -> Equilibrium:
        """The equilibrium with mu / rho [m^2/s^2] and a share of the weight that is held; the last ones are kept."""
        key = ratio, share
        if key not in self._solved:
            nearest = min(
                self._solved,
                key=lambda other: abs(math.log(other[0] / ratio)) + abs(other[1] - share),
                default=None,
            )
            start = None if nearest is None else self._solved[nearest].x
            forces = share * self.holding_forces(ratio) if share else None
            self._solved[key] = solve_equilibrium(
                self.body, self.law, self.shear_modulus / ratio, self.gravity, self.clamps, start, forces
            )
            if len(self._solved) > 12:
                self._solved.pop(next(iter(self._solved)))
        return self._solved[key]

    @property
    def gravity(self) -> Array:
        """Acceleration in the body's frame [m/s^2], shape (3,)."""
        return -GRAVITY * self.rotation[1]

    def holding_forces(self, ratio: float) -> Array:
        """Forces on the nodes (N, 3) [N] that hold the whole weight of the free part.

        Raises:
            InputError: no node that is free is in the box.
        """
        free = ~clamped_nodes(self.body, self.clamps)
        slack = 1e-6 * np.ptp(self.body.nodes, axis=0).max()
        inside = np.zeros(len(free), dtype=bool)
        if self.held is not None:
            low, high = self.held[0] - slack, self.held[1] + slack
            inside = free & ((self.body.nodes >= low) & (self.body.nodes <= high)).all(axis=1)
        if not inside.any():
            raise InputError("held", "contains no node of the body that is free", "Give a region of the body")
        volumes = self.body.node_volumes
        shares = np.where(inside, volumes, 0.0) / volumes[inside].sum()
        return -self.shear_modulus / ratio * volumes[free].sum() * shares[:, None] * self.gravity

    def positions(self, shape: Array) -> Array:
        return self.weights @ self.at_rest(*map(float, shape[:2])).x

    def derivatives(self, shape: Array, free: Sequence[int]) -> Array:
        ratio, share = map(float, shape[:2])
        rest = self.at_rest(ratio, share)
        held = rest.response(self.holding_forces(ratio)) if HELD in free else np.zeros_like(rest.x)
        bends = (rest.by_stiffness, held, *np.zeros((2, *rest.x.shape)))
        return np.stack([self.weights @ bend for bend in bends])


@dataclass(frozen=True, eq=False)
class StillFit:
    """A body fitted to a still.

    Attributes:
        pose: marker to camera, shape (4, 4).
        placement: origin of the body's frame in the marker's frame [m], shape (3,).
        shape: numbers of `ClampedBody`.
        shape_std: standard deviations, of the first and last of their logarithms, from noise and placement, with
            residuals of the silhouette that are correlated over 30 px, and enlarged where they exceed the assumed
            noise; 0 if given.
        centre: change of the principal point [px].
        placement_std: of the placement [m], shape (3,).
        contour_rms: root mean square distance of the visible observed silhouette from the outline [px].
        marker_rms: of the marker's corners [px].
        iou: intersection over union of masks where the body is not hidden.
        cost: weighted sum of squares with the prior's, of all stills that were fitted together.
        predicted: mask of the body in equilibrium, hidden parts included, shape (H, W).
        hidden: pixels of hidden parts, which are not compared, shape (H, W).
    """

    pose: Array
    placement: Array
    shape: tuple[float, ...]
    shape_std: tuple[float, ...]
    centre: tuple[float, float]
    placement_std: Array
    contour_rms: float
    marker_rms: float
    iou: float
    cost: float
    predicted: NDArray[np.bool_]
    hidden: NDArray[np.bool_]

    @property
    def ratio(self) -> float:
        """mu / rho [m^2/s^2]."""
        return self.shape[0]

    @property
    def log_std(self) -> float:
        """Standard deviation of its logarithm."""
        return self.shape_std[0]


class StillResiduals:
    """Residuals of a still in units of standard deviations, for `levenberg_marquardt`.

    Unknowns u (15,) are changes in units of `_SCALES`: of the camera's rotation and translation, of the placement in
    standard deviations of its prior, of the numbers of the body's shape, and of the principal point.

    Args:
        still: with the pose of its camera in the frame of the first.
        body: the body, whose surface depends on the numbers of its shape.
        pose: marker to the first camera.
        shape: mu / rho [m^2/s^2], and the other numbers of the shape, 0 if they are not given.
        centre: change of the principal point [px]. None: the given one is exact.
    """

    def __init__(
        self,
        still: Still,
        body: ClampedBody,
        pose: Array,
        placement: Array,
        placement_std: float,
        *shape: float,
        centre: tuple[float, float] | None = None,
    ):
        self.still, self.body = still, body
        self.start = pose, placement, np.array([*shape, 0.0, 0.0, 0.0][:4]), np.array(centre or (0.0, 0.0))
        self.scales = _SCALES.copy()
        self.scales[PLACEMENT] *= placement_std
        self.scales[CENTRE] *= centre is not None
        self.contour = contour(still.mask, still.unknown)
        step = np.median(np.linalg.norm(np.diff(self.contour, axis=0), axis=1))
        self.weight = math.sqrt(step / _CORRELATED) / _CONTOUR_NOISE
        self.visible = np.ones(len(self.contour), dtype=bool)

    def values(self, u: Array) -> tuple[Array, Array, Array, Array]:
        """Pose (4, 4), placement (3,), numbers of the shape (4,) and change of the principal point (2,) of unknowns."""
        pose, placement, shape, centre = self.start
        change = self.scales * u
        pose = pose.copy()
        pose[:3, :3] = pose[:3, :3] @ Rotation.from_rotvec(change[ROTATION]).as_matrix()
        pose[:3, 3] += change[TRANSLATION]
        shape = np.where(_OF_LOGARITHM, shape * np.exp(change[_SHAPE]), shape + change[_SHAPE])
        return pose, placement + change[PLACEMENT], shape, centre + change[CENTRE]

    def _project(self, u: Array, points: Array) -> tuple[Array, Array]:
        """Pixels (P, 2) of points (P, 3) in the marker's frame, and derivatives by their positions there (P, 2, 3)."""
        pose, _, _, centre = self.values(u)
        seen = self.still.camera @ pose
        local = points @ seen[:3, :3].T + seen[:3, 3]
        z = local[:, 2:]
        if not (z > 0).all():
            raise NonFiniteError("still", "the body is behind the camera")
        image = local @ self.still.K.T
        pixels = image[:, :2] / z
        slopes = (self.still.K[:2] - pixels[:, :, None] * self.still.K[2]) / z[..., None]
        return pixels + centre, slopes @ seen[:3, :3]

    def surface(self, u: Array) -> tuple[Array, Array, Array]:
        """Positions of the surface in the marker's frame (P, 3), pixels (P, 2) and `_project`'s derivatives."""
        _, placement, shape, _ = self.values(u)
        points = self.body.positions(shape) @ self.body.rotation.T + placement
        return points, *self._project(u, points)

    def _distances(self, pixels: Array) -> tuple[Outline, NDArray[np.int64], Array, Array]:
        edge = outline(pixels, self.body.triangles)
        return edge, *edge.nearest(pixels, self.contour)

    def choose_visible(self, u: Array) -> bool:
        """Leave out points of the silhouette at hidden parts of the body, and those whose nearest points of the outline
        are hidden; whether they change."""
        pixels = self.surface(u)[1]
        edge, segment, _, _ = self._distances(pixels)
        visible = ~self.body.hidden_points[edge.vertices[segment]].any(axis=1)
        visible &= ~_sampled(self.hidden(pixels, _HIDDEN_MARGIN), self.contour)
        changed, self.visible = bool((visible != self.visible).any()), visible
        return changed

    def hidden(self, pixels: Array, margin: int) -> NDArray[np.bool_]:
        """Pixels (H, W) of the hidden parts of the body, with a margin [px]."""
        inside = self.body.hidden_points[self.body.triangles].all(axis=1)
        mask = silhouette(pixels, self.body.triangles[inside], *self.still.mask.shape)
        return np.asarray(binary_dilation(mask, iterations=margin), dtype=bool)

    def distances(self, u: Array) -> Array:
        """Distances (C,) of all points of the observed silhouette from the outline [px]."""
        return np.linalg.norm(self._distances(self.surface(u)[1])[3], axis=1)

    def _corners(self, u: Array) -> tuple[Array, Array]:
        """Residuals of the marker's corners (2 M,) and their derivatives by the unknowns (2 M, 15)."""
        pixels, slopes = self._project(u, self.still.marker)
        J = np.zeros((2 * len(pixels), UNKNOWNS))
        self._by_pose(J, u, self.still.marker, slopes.reshape(-1, 3))
        J.reshape(-1, 2, UNKNOWNS)[:, :, CENTRE] = np.diag(self.scales[CENTRE])
        return (pixels - self.still.marker_pixels).ravel() / _MARKER_NOISE, J / _MARKER_NOISE

    def _by_pose(self, J: Array, u: Array, points: Array, slopes: Array) -> None:
        """Write derivatives by the pose of rows whose derivatives by the position in the marker's frame are given."""
        rows = len(slopes) // max(1, len(points))
        turned = Rotation.from_rotvec((self.scales * u)[ROTATION])
        jacobian = _right_jacobian(turned.as_rotvec())
        moved = np.cross(np.repeat(points, rows, axis=0), slopes)  # s . (w x p) = w . (p x s)
        J[:, ROTATION] = moved @ jacobian * self.scales[ROTATION]
        J[:, TRANSLATION] = slopes @ self.values(u)[0][:3, :3].T * self.scales[TRANSLATION]

    def _evaluate(self, u: Array, free: Sequence[int]) -> tuple[Array, Array]:
        """Robust residuals in units of standard deviations and their derivatives: silhouette, then marker."""
        points, pixels, slopes = self.surface(u)
        edge, segment, share, offsets = self._distances(pixels)
        distance = np.linalg.norm(offsets, axis=1)
        direction = offsets / np.maximum(distance, 1e-9)[:, None]
        flat = distance < 1e-6  # on the outline: along its normal
        if flat.any():
            along = np.diff(pixels[edge.vertices[segment[flat]]], axis=1)[:, 0]
            direction[flat] = (
                np.stack([-along[:, 1], along[:, 0]], axis=1) / np.linalg.norm(along, axis=1)[:, None]
            )
        J = np.zeros((len(self.contour), UNKNOWNS))
        bends = self.body.derivatives(self.values(u)[2], free) @ self.body.rotation.T
        for end, weight in ((0, 1 - share), (1, share)):
            vertex = edge.vertices[segment, end]
            own = weight[:, None] * np.einsum("qi,qij->qj", direction, slopes[vertex])
            part = np.zeros_like(J)
            self._by_pose(part, u, points[vertex], own)
            part[:, PLACEMENT] = own * self.scales[PLACEMENT]
            part[:, _SHAPE] = np.einsum("qi,kqi->qk", own, bends[:, vertex]) * self.scales[_SHAPE]
            J += part
        J[:, CENTRE] = direction * self.scales[CENTRE]
        # Huber's cost as a square: its root, with that root's derivative
        far = np.maximum(distance, _ROBUST)
        root = np.where(distance > _ROBUST, np.sqrt(_ROBUST * (2 * far - _ROBUST)), distance)
        slope = np.where(distance > _ROBUST, _ROBUST / np.sqrt(_ROBUST * (2 * far - _ROBUST)), 1.0)
        kept = self.weight * self.visible
        corner, J_corner = self._corners(u)
        return np.concatenate([kept * root, corner]), np.concatenate([(kept * slope)[:, None] * J, J_corner])

    def cost(self, unknowns: Array) -> float:
        try:
            residual = self._evaluate(unknowns, ())[0]
        except NonFiniteError:
            return math.inf
        return float(residual @ residual)

    def linearise(self, unknowns: Array, free: Sequence[int], exact: bool = True) -> Linearisation:
        residual, J = self._evaluate(unknowns, free)
        J[:, np.setdiff1d(np.arange(UNKNOWNS), free)] = 0
        rms = float(np.sqrt((residual**2).mean()))
        return Linearisation((J.T @ J)[None], (J.T @ residual)[None], float(residual @ residual), rms)


def _right_jacobian(w: Array) -> Array:
    """J with exp(w + d) = exp(w) exp(J d) to first order, shape (3, 3), for rotation vectors w (3,) [rad]."""
    angle = float(np.linalg.norm(w))
    W = np.array([[0, -w[2], w[1]], [w[2], 0, -w[0]], [-w[1], w[0], 0]])
    if angle < 1e-6:
        return np.eye(3) - W / 2
    return np.eye(3) - (1 - np.cos(angle)) / angle**2 * W + (angle - np.sin(angle)) / angle**3 * W @ W


def fit_still(
    still: Still,
    body: RestingBody,
    poses: Sequence[Array],
    placement: Array,
    placement_std: float,
    ratio: float,
    fixed_ratio: bool = False,
    iterations: int = 30,
) -> StillFit:
    """Fit pose, placement and mu / rho to a still.

    Args:
        poses: initial poses of the marker in the camera's frame, (4, 4) each, such as both that a planar marker has.
            The one that fits best with the silhouette is kept.
        placement: prior mean of the origin of the body's frame in the marker's frame [m], shape (3,).
        placement_std: standard deviation of the prior on each axis [m].
        ratio: initial mu / rho, or the given one [m^2/s^2].
        fixed_ratio: whether to predict with the given ratio. Pose and placement are then fitted alone.

    Raises:
        InputError: the mask is empty.
        NonFiniteError: no pose leads to a finite fit.
    """
    free = [*range(9)] if fixed_ratio else [*range(9), RATIO]
    problems = [
        Stills([StillResiduals(still, body, pose, placement, placement_std, ratio)]) for pose in poses
    ]
    fits = [
        (problem, *problem.minimise(np.zeros(UNKNOWNS), free, iterations))
        for problem in problems
        if math.isfinite(problem.cost(np.zeros(UNKNOWNS)))
    ]
    if not fits:
        raise NonFiniteError("still", "no initial pose shows the body in front of the camera")
    problem, u, fit = min(fits, key=lambda each: total_cost(*each[1:]))
    return problem.results(u, fit, free)[0]


class Stills:
    """Stills that share all unknowns, for `levenberg_marquardt`."""

    def __init__(self, parts: Sequence[StillResiduals]):
        self.parts = parts

    def cost(self, unknowns: Array) -> float:
        return sum(part.cost(unknowns) for part in self.parts)

    def linearise(self, unknowns: Array, free: Sequence[int], exact: bool = True) -> Linearisation:
        parts = [part.linearise(unknowns, free) for part in self.parts]
        curvatures, scores = (
            np.stack([getattr(part, key) for part in parts]) for key in ("curvature", "slope")
        )
        rms = float(np.sqrt(np.mean([part.rms**2 for part in parts])))
        return Linearisation(curvatures, scores, sum(part.cost for part in parts), rms)

    def minimise(
        self, start: Array, free: Sequence[int], iterations: int, min_gain: float = 1e-5
    ) -> tuple[Array, Linearisation]:
        """Unknowns and the problem linearised there, with the points of the silhouettes that are visible there."""
        u = start
        for attempt in range(_ROUNDS):
            changed = [part.choose_visible(u) for part in self.parts]
            if not any(changed) and attempt:
                break
            u, _, _ = levenberg_marquardt(self, u, free, _prior, min_gain, iterations, longest=_MAX_STEP)
        return u, self.linearise(u, free)

    def results(self, u: Array, fit: Linearisation, free: Sequence[int]) -> list[StillFit]:
        """A result for each still."""
        inner, cost = np.ix_(free, free), total_cost(u, fit)
        covariance = np.zeros((UNKNOWNS, UNKNOWNS))
        covariance[inner] = np.linalg.inv((fit.curvature + _prior(fit))[inner])
        independent = sum(
            part.visible.sum() * (part.weight * _CONTOUR_NOISE) ** 2 + 2 * len(part.still.marker)
            for part in self.parts
        )
        misfit = max(1.0, cost / max(1.0, independent - len(free) + 3))  # the prior adds three values
        deviations = np.sqrt(misfit * np.diag(covariance))
        return [_result(part, u, deviations, cost) for part in self.parts]


def total_cost(u: Array, fit: Linearisation) -> float:
    """Sum of squares with those of the prior."""
    return float(fit.cost + u @ _prior(fit) @ u)


def _prior(fit: Linearisation) -> Array:
    """Curvature of the prior: 1 of the placement, and next to nothing of others."""
    P = np.full(UNKNOWNS, 1e-9)
    P[PLACEMENT] = 1.0
    return np.diag(P)


def _result(residuals: StillResiduals, u: Array, deviations: Array, cost: float) -> StillFit:
    still, body = residuals.still, residuals.body
    pose, placement, shape, centre = residuals.values(u)
    std = residuals.scales * deviations
    distance = residuals.distances(u)[residuals.visible]
    corners = residuals._corners(u)[0] * _MARKER_NOISE
    _, pixels, _ = residuals.surface(u)
    height, width = still.mask.shape
    predicted = silhouette(pixels, body.triangles, height, width)
    hidden = residuals.hidden(pixels, _HIDDEN_MARGIN)
    compared = ~hidden if still.unknown is None else ~(hidden | still.unknown)
    union = ((predicted | still.mask) & compared).sum()
    iou = ((predicted & still.mask) & compared).sum() / max(1, union)
    return StillFit(
        pose, placement, tuple(shape.tolist()), tuple(std[_SHAPE].tolist()), tuple(centre.tolist()), std[PLACEMENT],
        float(np.sqrt((distance**2).mean())), float(np.sqrt((corners**2).mean() * 2)) if len(corners) else 0.0,
        float(iou), cost, predicted, hidden,
    )  # fmt: skip
