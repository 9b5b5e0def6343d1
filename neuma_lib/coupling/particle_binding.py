"""Gaussian-particle binding: Algorithm 1 of the paper as a sparse matrix.

Row i of the binding matrix B (G, N) contains the weights of the particles that move Gaussian i, by
``x_t = x_0 + B (p_t - p_0)`` and ``F_bar = B F`` (paper, section 3.3). The dense matrix is never formed, and only
particles near a Gaussian are tested.
"""

from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from neuma_lib.config.binding import BindingConfig
from neuma_lib.coupling.binding import Binding
from neuma_lib.coupling.particle_binding_kernels import search
from neuma_lib.device import launch
from neuma_lib.errors import InputError

_FLATTEST = 1e-12  # minimum eigenvalue of a covariance, relative to its largest one
_CELLS_ALONG_Z = 2**20
_SHARING_NEIGHBOURS = 16  # number of particles that give volume to an added particle
_MAX_SHARE = 0.5  # maximum fraction of a particle's volume that goes to added particles
_UNBALANCED = 1e-9
"""Residual, relative to the neighbours' distance, above which no shares balance an added particle."""


def bind(means: Tensor, covars: Tensor, particles: Tensor, settings: BindingConfig | None = None) -> Binding:
    """Bind every Gaussian to the particles inside its confidence ellipsoid (paper, Algorithm 1).

    Particle j is inside Gaussian i if ``(p_j - x_i)^T A_i^-1 (p_j - x_i) <= chi2_3(confidence)``. The
    ``max_neighbours`` nearest in that distance (the smaller index first for equal distances) have equal weights.

    Args:
        means: Gaussian centres [m], shape (G, 3).
        covars: Gaussian covariances [m^2], shape (G, 3, 3).
        particles: particle positions [m], shape (N, 3); the computation runs on their device.
        settings: confidence of the ellipsoid and maximum number of particles per row; None for the defaults.

    Returns:
        Binding of shape (G, N) on the device and with the dtype of ``means``; rows may be empty.

    Raises:
        InputError: inconsistent shapes, values that are not finite, a covariance that is not positive definite.
    """
    centres, shapes, points = _checked(means, covars, particles)
    settings = settings or BindingConfig()
    return _Ellipsoids.of(centres, shapes, settings).bind(_Columns.of(points), settings, means)


def bind_two_pass(
    means: Tensor,
    covars: Tensor,
    particles: Tensor,
    volumes: Tensor | float,
    settings: BindingConfig | None = None,
) -> tuple[Binding, Tensor, int, Tensor]:
    """Bind in two passes, so that every Gaussian has a particle (paper, section 3.4).

    A particle is added at the centre of each Gaussian that is empty after the first pass. The second pass binds all
    Gaussians to all particles. By default an added particle takes its volume from its neighbours, in proportions whose
    barycentre is its position. This preserves total volume and centre of mass (for a uniform density) to round-off and
    keeps all volumes positive. If the neighbours lie in one plane, the barycentre is the nearest point of the plane.

    Args:
        means, covars, particles: see ``bind``.
        volumes: particle volumes [m^3], shape (N,), or the object's volume [m^3], which is divided equally.
        settings: see ``bind``. ``equal_mass`` gives all N + M particles the object's volume / (N + M), as in the paper,
            which moves the centre of mass.

    Returns:
        the binding (G, N + M), the particles with the M added ones at the end (N + M, 3), M, the volumes (N + M,).

    Raises:
        InputError: see ``bind``; volumes that are not positive or do not match the particles.
    """
    centres, shapes, points = _checked(means, covars, particles)
    shares = _checked_volumes(volumes, len(points))
    settings = settings or BindingConfig()
    ellipsoids, columns = _Ellipsoids.of(centres, shapes, settings), _Columns.of(points)
    empty = torch.nonzero(ellipsoids.counts(columns, limit=1) == 0).flatten()

    if len(empty):
        # an added particle may also lie in the ellipsoids of other Gaussians
        added = centres[empty]
        columns = _Columns.of(torch.cat([points, added]))
        if settings.equal_mass:
            shares = np.full(len(columns.points), shares.sum() / len(columns.points))
        else:
            shares = _share_volumes(points.cpu().numpy(), shares, added.cpu().numpy())
    return (
        ellipsoids.bind(columns, settings, means),
        torch.cat([particles, means[empty.to(means.device)].to(particles)]),
        len(empty),
        torch.as_tensor(shares, dtype=particles.dtype, device=particles.device),
    )


def _checked(means: Tensor, covars: Tensor, particles: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Inputs in float64 on the device of the particles, checked for shapes and finite values."""
    if means.ndim != 2 or means.shape[1] != 3 or covars.shape != (len(means), 3, 3):
        problem = f"have shapes {tuple(means.shape)} and {tuple(covars.shape)}, expected (G, 3) and (G, 3, 3)"
        raise InputError("binding: means, covars", problem)
    if particles.ndim != 2 or particles.shape[1] != 3 or len(particles) == 0:
        problem = f"have shape {tuple(particles.shape)}, expected (N, 3) with N > 0"
        raise InputError("binding: particles", problem)
    checked = []
    for name, values in (("means", means), ("covars", covars), ("particles", particles)):
        values = values.detach().to(particles.device, torch.float64).contiguous()
        finite = values.isfinite().flatten(1).all(1)
        if not finite.all():
            problem = f"number {int(finite.int().argmin())} is not finite"
            raise InputError(f"binding: {name}", problem, "Run the stage that computes them again")
        checked.append(values)
    return checked[0], checked[1], checked[2]


def _checked_volumes(volumes: Tensor | float, count: int) -> np.ndarray:
    if isinstance(volumes, Tensor) and volumes.ndim:
        array = volumes.detach().to("cpu", torch.float64).numpy()
    else:
        array = np.full(count, float(volumes) / count)
    if array.shape != (count,):
        raise InputError("binding: volumes", f"have shape {array.shape}, but there are {count} particles")
    if not (np.isfinite(array).all() and (array > 0).all()):
        raise InputError("binding: volumes", "must be finite and positive", "Run the geometry stage again")
    return array


class _Columns(NamedTuple):
    """Points (N, 3) sorted into the cells of a grid: columns over the squares of a plane, divided along z."""

    lower: Tensor  # corner of the grid [m], (3,)
    # sides of a cell [m], (3,), so short along z that points of a column are almost sorted by z
    sides: Tensor
    shape: Tensor  # number of cells, (3,)
    begins: Tensor  # first point of each column, and the end, int32
    depths: Tensor  # cell of each point along z, int32, (N,)
    order: Tensor  # index of each point, int32, (N,)
    points: Tensor  # positions [m], column after column, ascending in z

    @classmethod
    def of(cls, points: Tensor) -> "_Columns":
        lower = points.amin(0)
        extent = points.amax(0) - lower
        # a square is about as wide as the particle spacing
        side = extent[:2].max() / max(1, round(len(points) ** (1 / 3)))
        sides = torch.stack([side, side, extent[2] / _CELLS_ALONG_Z])
        sides[sides == 0] = 1.0
        shape = (extent / sides).floor().long() + 1
        cell = ((points - lower) / sides).floor().long()
        keys, order = torch.sort((cell[:, 0] * shape[1] + cell[:, 1]) * shape[2] + cell[:, 2], stable=True)
        corners = torch.arange(int(shape[0] * shape[1]) + 1, device=points.device) * shape[2]
        begins, depths = torch.searchsorted(keys, corners), keys % shape[2]
        return cls(lower, sides, shape, begins.int(), depths.int(), order.int(), points[order])

    def cells(self, positions: Tensor) -> Tensor:
        """Cells (K, 3) of positions (K, 3), int32; -1 below the grid, the number of cells above it."""
        cells = ((positions - self.lower) / self.sides).floor().clamp(min=-1)
        return cells.minimum(self.shape.to(cells)).int()


class _Ellipsoids(NamedTuple):
    """Confidence ellipsoids of Gaussians."""

    centres: Tensor  # [m], (G, 3)
    whitening: Tensor  # matrices W with ``|W d|^2 = d^T A^-1 d``, (G, 3, 3)
    half: Tensor  # half the sides of the bounding boxes [m], (G, 3)
    threshold: float  # maximum squared Mahalanobis distance of a bound particle

    @classmethod
    def of(cls, centres: Tensor, shapes: Tensor, settings: BindingConfig) -> "_Ellipsoids":
        from scipy.special import chdtri  # here, because the import takes an eighth of a second

        eigenvalues, eigenvectors = np.linalg.eigh(shapes.cpu().numpy())
        largest = eigenvalues[:, 2]
        if not (largest > 0).all():
            problem = f"that of Gaussian {int(np.argmin(largest))} is not positive definite"
            raise InputError("binding: covars", problem, "Run the rule gaussians again")
        # a lower bound on the eigenvalues keeps the inverse of a flat covariance finite
        eigenvalues = np.maximum(eigenvalues, _FLATTEST * largest[:, None])
        whitening = np.ascontiguousarray(np.swapaxes(eigenvectors, 1, 2) / np.sqrt(eigenvalues)[:, :, None])
        threshold = float(chdtri(3, 1.0 - settings.confidence))
        floors = torch.from_numpy(_FLATTEST * largest[:, None]).to(shapes)
        half = (threshold * (shapes.diagonal(dim1=1, dim2=2) + floors)).sqrt() * (1 + 1e-9)
        return cls(centres, torch.from_numpy(whitening).to(shapes), half, threshold)

    def counts(self, columns: _Columns, limit: int | None) -> Tensor:
        """Number of points in each ellipsoid, int32, (G,), counted up to ``limit``."""
        counts = torch.empty(len(self.centres), dtype=torch.int32, device=self.centres.device)
        self._search(columns, limit or torch.iinfo(counts.dtype).max, counts, None, None, None)
        return counts

    def bind(self, columns: _Columns, settings: BindingConfig, like: Tensor) -> Binding:
        """The binding of Algorithm 1 to the points, on the device and with the dtype of ``like``.

        The search visits only cells in the bounding box of an ellipsoid, because splats have thin discs and needles.
        """
        counts = self.counts(columns, settings.max_neighbours).long()
        indptr = torch.cat([counts.new_zeros(1), counts.cumsum(0)])
        distances = self.centres.new_empty(int(indptr[-1]))
        indices = torch.empty_like(distances, dtype=torch.int32)
        self._search(columns, 0, None, indptr.int(), distances, indices)
        values = (1 / counts.double()).repeat_interleave(counts)
        shape = len(counts), len(columns.points)
        return Binding(indptr, indices.long(), values, shape).to(like.device, like.dtype)

    def _search(self, columns: _Columns, limit: int, *out: Tensor | None) -> None:
        first = columns.cells(self.centres - self.half).clamp(min=0)
        last = torch.minimum(columns.cells(self.centres + self.half), columns.shape.int() - 1)
        launch(
            search,
            len(self.centres),
            columns.begins,
            columns.depths,
            columns.order,
            columns.points,
            int(columns.shape[1]),
            self.centres,
            self.whitening,
            first,
            last,
            self.threshold,
            limit,
            *out,
        )


def _share_volumes(points: np.ndarray, volumes: np.ndarray, added: np.ndarray) -> np.ndarray:
    """Positive volumes of all particles, with the same sum and first moment as before particles were added.

    Added particle m at q takes ``w_m f_mj`` from its neighbour j, where ``sum_j f_mj = 1`` and
    ``sum_j f_mj p_j = q`` (the f of minimum norm, which has negative entries if q is outside its neighbours). w_m is an
    equal share among the group, reduced so that no particle gives more than ``_MAX_SHARE`` of its volume.
    """
    from scipy.spatial import cKDTree

    size = min(_SHARING_NEIGHBOURS, len(points))
    tree = cKDTree(points, balanced_tree=False, compact_nodes=False)  # faster to build, for few queries
    _, neighbours = tree.query(added, k=np.arange(1, size + 1))
    offsets = points[neighbours] - added[:, None, :]
    scale = np.sqrt(np.square(offsets).sum(2).mean(1))
    scale[scale == 0.0] = 1.0
    system = np.concatenate(
        [np.ones((len(added), 1, size)), np.swapaxes(offsets, 1, 2) / scale[:, None, None]], 1
    )
    wanted = np.array([1.0, 0.0, 0.0, 0.0])
    fractions = np.linalg.pinv(system, rcond=1e-8) @ wanted
    residual = np.abs(np.einsum("mak,mk->ma", system, fractions) - wanted).max(1)
    # Neighbours in a plane cannot balance a particle outside it. They balance its projection, so that the centre of
    # mass moves slightly but no particle has zero volume.
    off = residual > _UNBALANCED
    centre = offsets[off].mean(1)
    within = np.linalg.pinv(np.swapaxes(offsets[off] - centre[:, None], 1, 2), rcond=1e-8)
    fractions[off] = 1 / size - np.einsum("mka,ma->mk", within, centre)

    taken = np.maximum(fractions, 0.0)
    demand = np.bincount(neighbours.ravel(), taken.ravel(), minlength=len(points))
    with np.errstate(divide="ignore"):
        offer = np.where(taken > 0, (volumes / demand)[neighbours], np.inf).min(1)
    weight = np.minimum(volumes[neighbours].mean(1) * size / (size + 1), _MAX_SHARE * offer)
    given = np.bincount(neighbours.ravel(), (weight[:, None] * fractions).ravel(), minlength=len(points))
    return np.concatenate([volumes - given, weight])
