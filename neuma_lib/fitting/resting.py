"""Fit the specific stiffness of a clamped body to a photograph of it at rest under gravity.

Sag depends on the ratio of stiffness to density only, so that the unknown is mu / rho [m^2/s^2]. Other unknowns are
the pose of the camera, which one marker of the size of a stamp does not determine, and the placement of the body next
to the marker, with a prior. Residuals are the corners of the marker and the distances from points of the observed
silhouette to the outline of the body in equilibrium. Their derivatives are exact: by the stiffness through the implicit
function theorem, and by all unknowns at a fixed nearest point of the outline, since the nearest point moves along the
outline.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

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
from neuma_lib.sim.equilibrium import Equilibrium, solve_equilibrium
from neuma_lib.sim.hexahedra import Hexahedra

Array = NDArray[np.float64]
GRAVITY = 9.81
"""[m/s^2]"""
ROTATION, TRANSLATION, PLACEMENT, RATIO = slice(0, 3), slice(3, 6), slice(6, 9), 9
"""Unknowns: changes of the camera's pose and of the placement, and of log(mu / rho)."""
_SCALES = np.array([0.1, 0.1, 0.1, 0.01, 0.01, 0.01, 1.0, 1.0, 1.0, 0.1])  # of rad, m, (prior), 1
_CONTOUR_NOISE, _CORRELATED = (
    2.0,
    30.0,
)  # standard deviation [px] and length [px] over which residuals persist
_MARKER_NOISE = 0.5  # px
_ROBUST = 4.0  # residual beyond which the cost grows linearly [px]
_SPACING = 3.0  # of points of the observed silhouette [px]
_HIDDEN_MARGIN = 4  # px around hidden parts, in which the silhouette is that of what hides them
_ROUNDS = 4  # after each of which points near hidden parts are chosen again
_MAX_STEP = 3.0


def contours(mask: NDArray[np.bool_]) -> list[Array]:
    """Closed contours of a mask (H, W) with holes, shape (n, 2) each [px], pixel centres at half integers."""
    lines = find_contours(np.pad(mask, 1).astype(float), 0.5)
    return [line[:, ::-1] - 0.5 for line in lines]  # padding, and half a pixel


def contour(mask: NDArray[np.bool_]) -> Array:
    """Points of the longest contour of a mask (H, W) at equal distances, shape (C, 2) [px].

    Raises:
        InputError: the mask is empty.
    """
    lines = contours(mask)
    if not lines:
        raise InputError("mask", "shows no body")
    line = max(lines, key=len)
    reached = np.concatenate([[0], np.linalg.norm(np.diff(line, axis=0), axis=1).cumsum()])
    count = max(4, round(reached[-1] / _SPACING))
    sites = np.arange(count) * reached[-1] / count
    return np.stack([np.interp(sites, reached, line[:, axis]) for axis in (0, 1)], axis=1)


@dataclass(eq=False)
class RestingBody:
    """A clamped body whose equilibrium depends on mu / rho.

    Attributes:
        body: the undeformed body in its own frame.
        law: its elasticity. Only ratios of its moduli matter.
        shear_modulus: of the law at small strains [Pa].
        clamps: regions of the undeformed body that are held.
        rotation: from the body's frame to the marker's, shape (3, 3). Gravity is along -y of the marker's.
        hidden: box of the undeformed body behind another object, two corners, shape (2, 3) [m].
        surface_size: edge of the triangles of its surface [m].
    """

    body: Hexahedra
    law: Law
    shear_modulus: float
    clamps: Sequence[Clamp]
    rotation: Array
    hidden: Array
    surface_size: float
    _solved: dict[float, Equilibrium] = field(default_factory=dict)

    def __post_init__(self):
        self.weights, self.triangles = self.body.surface(self.surface_size)
        self.undeformed = self.weights @ self.body.nodes
        low, high = self.hidden
        self.hidden_points = ((self.undeformed >= low) & (self.undeformed <= high)).all(axis=1)

    def at_rest(self, ratio: float) -> Equilibrium:
        """The equilibrium with mu / rho [m^2/s^2]; the last ones are kept."""
        if ratio not in self._solved:
            nearest = min(self._solved, key=lambda other: abs(math.log(other / ratio)), default=None)
            start = None if nearest is None else self._solved[nearest].x
            gravity = -GRAVITY * self.rotation[1]
            density = self.shear_modulus / ratio
            self._solved[ratio] = solve_equilibrium(self.body, self.law, density, gravity, self.clamps, start)
            if len(self._solved) > 12:
                self._solved.pop(next(iter(self._solved)))
        return self._solved[ratio]


@dataclass(frozen=True, eq=False)
class StillFit:
    """A body fitted to a still.

    Attributes:
        pose: marker to camera, shape (4, 4).
        placement: origin of the body's frame in the marker's frame [m], shape (3,).
        ratio: mu / rho [m^2/s^2].
        log_std: standard deviation of its logarithm from noise and placement, with residuals of the silhouette that
            are correlated over 30 px, and enlarged where they exceed the assumed noise; 0 if the ratio was given.
        placement_std: of the placement [m], shape (3,).
        contour_rms: root mean square distance of the visible observed silhouette from the outline [px].
        marker_rms: of the marker's corners [px].
        iou: intersection over union of masks where the body is not hidden.
        cost: weighted sum of squares with the prior's.
        predicted: mask of the body in equilibrium, hidden parts included, shape (H, W).
        hidden: pixels of hidden parts, which are not compared, shape (H, W).
    """

    pose: Array
    placement: Array
    ratio: float
    log_std: float
    placement_std: Array
    contour_rms: float
    marker_rms: float
    iou: float
    cost: float
    predicted: NDArray[np.bool_]
    hidden: NDArray[np.bool_]


class StillResiduals:
    """Residuals of a still in units of standard deviations, for `levenberg_marquardt`.

    Unknowns u (10,) are changes in units of `_SCALES`: of the camera's rotation and translation, of the placement in
    standard deviations of its prior, and of log(mu / rho).
    """

    def __init__(
        self,
        still: Still,
        body: RestingBody,
        pose: Array,
        placement: Array,
        placement_std: float,
        ratio: float,
    ):
        self.still, self.body = still, body
        self.start = pose, placement, ratio
        self.scales = _SCALES * np.where(np.arange(10) // 3 == 2, placement_std, 1.0)
        self.scales[RATIO] = _SCALES[RATIO]
        self.contour = contour(still.mask)
        step = np.linalg.norm(self.contour[1] - self.contour[0])
        self.weight = math.sqrt(step / _CORRELATED) / _CONTOUR_NOISE
        self.visible = np.ones(len(self.contour), dtype=bool)

    def values(self, u: Array) -> tuple[Array, Array, float]:
        """Pose (4, 4), placement (3,) and ratio of unknowns."""
        pose, placement, ratio = self.start
        change = self.scales * u
        pose = pose.copy()
        pose[:3, :3] = pose[:3, :3] @ Rotation.from_rotvec(change[ROTATION]).as_matrix()
        pose[:3, 3] += change[TRANSLATION]
        return pose, placement + change[PLACEMENT], float(ratio * np.exp(change[RATIO]))

    def _project(self, pose: Array, points: Array) -> tuple[Array, Array]:
        """Pixels (P, 2) of points (P, 3) in the marker's frame, and derivatives by their positions there (P, 2, 3)."""
        local = points @ pose[:3, :3].T + pose[:3, 3]
        z = local[:, 2:]
        if not (z > 0).all():
            raise NonFiniteError("still", "the body is behind the camera")
        image = local @ self.still.K.T
        pixels = image[:, :2] / z
        slopes = (self.still.K[:2] - pixels[:, :, None] * self.still.K[2]) / z[..., None]
        return pixels, slopes @ pose[:3, :3]

    def surface(self, u: Array) -> tuple[Array, Array, Array]:
        """Positions of the surface in the marker's frame (P, 3), pixels (P, 2) and `_project`'s derivatives."""
        pose, placement, ratio = self.values(u)
        x = self.body.weights @ self.body.at_rest(ratio).x
        points = x @ self.body.rotation.T + placement
        return points, *self._project(pose, points)

    def _distances(self, pixels: Array) -> tuple[Outline, NDArray[np.int64], Array, Array]:
        edge = outline(pixels, self.body.triangles)
        return edge, *edge.nearest(pixels, self.contour)

    def choose_visible(self, u: Array) -> bool:
        """Leave out points of the silhouette at hidden parts of the body, and those whose nearest points of the outline
        are hidden; whether they change."""
        pixels = self.surface(u)[1]
        edge, segment, _, _ = self._distances(pixels)
        visible = ~self.body.hidden_points[edge.vertices[segment]].any(axis=1)
        behind = self.hidden(pixels, _HIDDEN_MARGIN)
        columns, rows = np.floor(self.contour).astype(int).T
        visible &= ~behind[rows.clip(0, len(behind) - 1), columns.clip(0, behind.shape[1] - 1)]
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
        """Residuals of the marker's corners (2 M,) and their derivatives by the unknowns (2 M, 10)."""
        pose = self.values(u)[0]
        pixels, slopes = self._project(pose, self.still.marker)
        J = np.zeros((2 * len(pixels), 10))
        self._by_pose(J, u, self.still.marker, slopes.reshape(-1, 3), pose)
        return (pixels - self.still.marker_pixels).ravel() / _MARKER_NOISE, J / _MARKER_NOISE

    def _by_pose(self, J: Array, u: Array, points: Array, slopes: Array, pose: Array) -> None:
        """Write derivatives by the pose of rows whose derivatives by the position in the marker's frame are given."""
        rows = len(slopes) // len(points)
        turned = Rotation.from_rotvec((self.scales * u)[ROTATION])
        jacobian = _right_jacobian(turned.as_rotvec())
        moved = np.cross(np.repeat(points, rows, axis=0), slopes)  # s . (w x p) = w . (p x s)
        J[:, ROTATION] = moved @ jacobian * self.scales[ROTATION]
        J[:, TRANSLATION] = slopes @ pose[:3, :3].T * self.scales[TRANSLATION]

    def _evaluate(self, u: Array) -> tuple[Array, Array]:
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
        pose, _, ratio = self.values(u)
        J = np.zeros((len(self.contour), 10))
        bend = self.body.weights @ self.body.at_rest(ratio).by_stiffness @ self.body.rotation.T
        for end, weight in ((0, 1 - share), (1, share)):
            vertex = edge.vertices[segment, end]
            own = weight[:, None] * np.einsum("qi,qij->qj", direction, slopes[vertex])
            part = np.zeros_like(J)
            self._by_pose(part, u, points[vertex], own, pose)
            part[:, PLACEMENT] = own * self.scales[PLACEMENT]
            part[:, RATIO] = (own * bend[vertex]).sum(axis=1) * self.scales[RATIO]
            J += part
        # Huber's cost as a square: its root, with that root's derivative
        far = np.maximum(distance, _ROBUST)
        root = np.where(distance > _ROBUST, np.sqrt(_ROBUST * (2 * far - _ROBUST)), distance)
        slope = np.where(distance > _ROBUST, _ROBUST / np.sqrt(_ROBUST * (2 * far - _ROBUST)), 1.0)
        kept = self.weight * self.visible
        corner, J_corner = self._corners(u)
        return np.concatenate([kept * root, corner]), np.concatenate([(kept * slope)[:, None] * J, J_corner])

    def cost(self, unknowns: Array) -> float:
        try:
            residual = self._evaluate(unknowns)[0]
        except NonFiniteError:
            return math.inf
        return float(residual @ residual)

    def linearise(self, unknowns: Array, free: Sequence[int], exact: bool = True) -> Linearisation:
        residual, J = self._evaluate(unknowns)
        J[:, np.setdiff1d(np.arange(10), free)] = 0
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
    free = [k for k in range(10) if k != RATIO or not fixed_ratio]
    fits: list[tuple[StillResiduals, Array, Linearisation]] = []
    for pose in poses:
        residuals = StillResiduals(still, body, pose, placement, placement_std, ratio)
        if math.isfinite(residuals.cost(np.zeros(10))):
            fits.append((residuals, *_minimise(residuals, free, iterations)))
    if not fits:
        raise NonFiniteError("still", "no initial pose shows the body in front of the camera")
    costs = [float(fit.cost + u @ _prior(fit) @ u) for _, u, fit in fits]
    best = int(np.argmin(costs))
    return _result(free, costs[best], *fits[best])


def _minimise(residuals: StillResiduals, free: Sequence[int], iterations: int) -> tuple[Array, Linearisation]:
    """Unknowns and the problem linearised there, with the points of the silhouette that are visible there."""
    u: Array = np.zeros(10)
    for attempt in range(_ROUNDS):
        if not residuals.choose_visible(u) and attempt:
            break
        u, _, _ = levenberg_marquardt(residuals, u, free, _prior, 1e-5, iterations, longest=_MAX_STEP)
    return u, residuals.linearise(u, free)


def _prior(fit: Linearisation) -> Array:
    """Curvature of the prior: 1 of the placement, and next to nothing of others."""
    P = np.full(10, 1e-9)
    P[PLACEMENT] = 1.0
    return np.diag(P)


def _result(
    free: Sequence[int], cost: float, residuals: StillResiduals, u: Array, fit: Linearisation
) -> StillFit:
    still, body = residuals.still, residuals.body
    pose, placement, ratio = residuals.values(u)
    inner = np.ix_(free, free)
    covariance = np.zeros((10, 10))
    covariance[inner] = np.linalg.inv((fit.curvature + _prior(fit))[inner])
    independent = residuals.visible.sum() * (residuals.weight * _CONTOUR_NOISE) ** 2 + 2 * len(still.marker)
    misfit = max(1.0, cost / max(1.0, independent - len(free) + 3))  # the prior adds three values
    std = np.asarray(residuals.scales * np.sqrt(misfit * np.diag(covariance)), dtype=np.float64)
    distance = residuals.distances(u)[residuals.visible]
    corners = residuals._corners(u)[0] * _MARKER_NOISE
    _, pixels, _ = residuals.surface(u)
    height, width = still.mask.shape
    predicted = silhouette(pixels, body.triangles, height, width)
    hidden = residuals.hidden(pixels, _HIDDEN_MARGIN)
    compared = ~hidden
    union = ((predicted | still.mask) & compared).sum()
    iou = ((predicted & still.mask) & compared).sum() / max(1, union)
    return StillFit(
        pose, placement, ratio, float(std[RATIO]), std[PLACEMENT],
        float(np.sqrt((distance**2).mean())), float(np.sqrt((corners**2).mean() * 2)), float(iou), cost,
        predicted, hidden,
    )  # fmt: skip
