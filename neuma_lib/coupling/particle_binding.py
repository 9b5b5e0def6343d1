"""Gaussian-particle binding: Algorithm 1 of the paper as a sparse matrix.

Row i of the binding matrix B (G, N) holds the weights of the particles that carry Gaussian i, so that Gaussians follow
the particles by ``x_t = x_0 + B (p_t - p_0)`` and ``F_bar = B F`` (paper, section 3.3). The dense matrix is never
formed, and the ellipsoid test touches only particles near each Gaussian.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch
from scipy.spatial import cKDTree
from scipy.special import chdtri
from torch import Tensor

from neuma_lib.config.binding import BindingConfig
from neuma_lib.coupling.binding import Binding
from neuma_lib.coupling.particle_binding_kernels import search
from neuma_lib.device import launch
from neuma_lib.errors import InputError

_FLATTEST = 1e-12
"""Least eigenvalue of a covariance, relative to its largest one."""
_DEEPEST = 2**20
"""Cells of a grid along z."""
_SHARING_NEIGHBOURS = 16
"""Particles among which an added particle's volume is collected."""
_LARGEST_SHARE = 0.5
"""Part of a particle's volume that all added particles together may take from it."""
_UNBALANCED = 1e-9
"""Residual, relative to the neighbours' distance, above which no shares balance an added particle."""


def bind(means: Tensor, covars: Tensor, particles: Tensor, settings: BindingConfig | None = None) -> Binding:
    """Bind every Gaussian to the particles inside its confidence ellipsoid (paper, Algorithm 1).

    Particle j belongs to Gaussian i when ``(p_j - x_i)^T A_i^-1 (p_j - x_i) <= chi2_3(confidence)``; of
    these the ``max_neighbours`` nearest in that distance are kept (the smaller index first where two are
    equally far) and share the weight equally.

    Args:
        means: Gaussian centres [m], shape (G, 3).
        covars: Gaussian covariances [m^2], shape (G, 3, 3).
        particles: particle positions [m], shape (N, 3); computed where they lie.
        settings: confidence of the ellipsoid and most particles in a row; None for the defaults.

    Returns:
        Binding of shape (G, N) on the device and with the dtype of ``means``; rows may be empty.

    Raises:
        InputError: shapes that do not fit, non-finite values, a covariance that is not positive definite.
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
    """Bind twice, so that no Gaussian is left without a particle (paper, section 3.4).

    Gaussians that the first pass leaves empty get a particle of their own at their centre; the second pass binds all
    Gaussians to the enlarged set. By default each added particle takes its volume from those around it, in proportions
    whose barycentre is its own position: total volume and centre of mass (at one density) are unchanged to round-off
    and every volume is positive. Where the others lie in one plane the barycentre is the nearest point of the plane.

    Args:
        means, covars, particles: as in ``bind``.
        volumes: particle volumes [m^3], shape (N,), or the object's volume [m^3], to be spread evenly.
        settings: as in ``bind``; ``equal_mass`` gives all N + M particles the object's volume / (N + M), as the
            paper does: the total stays, the centre of mass moves.

    Returns:
        the binding (G, N + M), the particles with the M added ones at the end (N + M, 3), M, the volumes (N + M,).

    Raises:
        InputError: as ``bind``; volumes that are not positive or do not fit the particles.
    """
    centres, shapes, points = _checked(means, covars, particles)
    shares = _checked_volumes(volumes, len(points))
    settings = settings or BindingConfig()
    ellipsoids, columns = _Ellipsoids.of(centres, shapes, settings), _Columns.of(points)
    orphans = torch.nonzero(ellipsoids.counts(columns, most=1) == 0).flatten()

    if len(orphans):
        # An added particle may lie inside its neighbours' ellipsoids as well.
        added = centres[orphans]
        columns = _Columns.of(torch.cat([points, added]))
        if settings.equal_mass:
            shares = np.full(len(columns.points), shares.sum() / len(columns.points))
        else:
            shares = _share_volumes(points.cpu().numpy(), shares, added.cpu().numpy())
    return (
        ellipsoids.bind(columns, settings, means),
        torch.cat([particles, means[orphans.to(means.device)].to(particles)]),
        len(orphans),
        torch.as_tensor(shares, dtype=particles.dtype, device=particles.device),
    )


def _checked(means: Tensor, covars: Tensor, particles: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Inputs in float64 on the device of the particles, after checks of shapes and finiteness."""
    if means.ndim != 2 or means.shape[1] != 3 or covars.shape != (len(means), 3, 3):
        raise InputError(
            f"binding: Gaussian means {tuple(means.shape)} and covariances {tuple(covars.shape)} must be "
            "(G, 3) and (G, 3, 3)"
        )
    if particles.ndim != 2 or particles.shape[1] != 3 or len(particles) == 0:
        raise InputError(f"binding: particles {tuple(particles.shape)} must be (N, 3) with N > 0")
    checked = []
    for name, values in (("Gaussian mean", means), ("Gaussian covariance", covars), ("particle", particles)):
        values = values.detach().to(particles.device, torch.float64).contiguous()
        finite = values.isfinite().flatten(1).all(1)
        if not finite.all():
            raise InputError(
                f"binding: {name} {int(finite.int().argmin())} is not finite; rerun the stage that made it"
            )
        checked.append(values)
    return checked[0], checked[1], checked[2]


def _checked_volumes(volumes: Tensor | float, count: int) -> np.ndarray:
    if isinstance(volumes, Tensor) and volumes.ndim:
        array = volumes.detach().to("cpu", torch.float64).numpy()
    else:
        array = np.full(count, float(volumes) / count)
    if array.shape != (count,):
        raise InputError(f"binding: {array.shape} volumes do not fit {count} particles")
    if not (np.isfinite(array).all() and (array > 0).all()):
        raise InputError("binding: particle volumes must be finite and positive; rerun the geometry stage")
    return array


class _Columns(NamedTuple):
    """Points (N, 3) in a grid: columns that stand on the squares of a plane, and cells one above the other in them.

    Attributes:
        lower: corner of the grid [m], (3,).
        sides: of a cell [m], (3,); those along z are so thin that points of a column are almost sorted by z.
        shape: number of cells, (3,).
        begins: of the points of each column, and the end, int32.
        depths: cell of each point along z, int32, (N,).
        order: index of each point, int32, (N,).
        points: positions [m], column after column, upwards in each.
    """

    lower: Tensor
    sides: Tensor
    shape: Tensor
    begins: Tensor
    depths: Tensor
    order: Tensor
    points: Tensor

    @classmethod
    def of(cls, points: Tensor) -> _Columns:
        lower = points.amin(0)
        extent = points.amax(0) - lower
        # a square is about as wide as points in a body are apart
        side = extent[:2].max() / max(1, round(len(points) ** (1 / 3)))
        sides = torch.stack([side, side, extent[2] / _DEEPEST])
        sides[sides == 0] = 1.0
        shape = (extent / sides).floor().long() + 1
        cell = ((points - lower) / sides).floor().long()
        keys, order = torch.sort((cell[:, 0] * shape[1] + cell[:, 1]) * shape[2] + cell[:, 2], stable=True)
        corners = torch.arange(int(shape[0] * shape[1]) + 1, device=points.device) * shape[2]
        begins, depths = torch.searchsorted(keys, corners), keys % shape[2]
        return cls(lower, sides, shape, begins.int(), depths.int(), order.int(), points[order])

    def cells(self, positions: Tensor) -> Tensor:
        """Cells (K, 3) of positions (K, 3), int32; beyond the grid -1, or the first number that no cell has."""
        cells = ((positions - self.lower) / self.sides).floor().clamp(min=-1)
        return cells.minimum(self.shape.to(cells)).int()


class _Ellipsoids(NamedTuple):
    """Confidence ellipsoids of Gaussians.

    Attributes:
        centres: [m], (G, 3).
        whitening: maps W with ``|W d|^2 = d^T A^-1 d``, (G, 3, 3).
        half: half the sides of the boxes about them [m], (G, 3).
        threshold: largest squared Mahalanobis distance of a bound particle.
    """

    centres: Tensor
    whitening: Tensor
    half: Tensor
    threshold: float

    @classmethod
    def of(cls, centres: Tensor, shapes: Tensor, settings: BindingConfig) -> _Ellipsoids:
        eigenvalues, eigenvectors = np.linalg.eigh(shapes.cpu().numpy())
        largest = eigenvalues[:, 2]
        if not (largest > 0).all():
            worst = int(np.argmin(largest))
            raise InputError(
                f"binding: the covariance of Gaussian {worst} is not positive definite; rerun the gaussians stage"
            )
        # A disc fitted flat has a third axis at round-off: its floor keeps the inverse finite.
        eigenvalues = np.maximum(eigenvalues, _FLATTEST * largest[:, None])
        whitening = np.ascontiguousarray(np.swapaxes(eigenvectors, 1, 2) / np.sqrt(eigenvalues)[:, :, None])
        threshold = float(chdtri(3, 1.0 - settings.confidence))
        floors = torch.from_numpy(_FLATTEST * largest[:, None]).to(shapes)
        half = (threshold * (shapes.diagonal(dim1=1, dim2=2) + floors)).sqrt() * (1 + 1e-9)
        return cls(centres, torch.from_numpy(whitening).to(shapes), half, threshold)

    def counts(self, columns: _Columns, most: int | None) -> Tensor:
        """How many points each ellipsoid holds, int32, (G,), counted up to ``most``."""
        counts = torch.empty(len(self.centres), dtype=torch.int32, device=self.centres.device)
        self._search(columns, most or torch.iinfo(counts.dtype).max, counts, None, None, None)
        return counts

    def bind(self, columns: _Columns, settings: BindingConfig, like: Tensor) -> Binding:
        """The binding of Algorithm 1 to the points, on the device and with the dtype of ``like``.

        An ellipsoid looks at the points in those cells that its box meets, so that it costs no more where others are
        many: splats have discs and needles many times longer than they are thick.
        """
        counts = self.counts(columns, settings.max_neighbours).long()
        indptr = torch.cat([counts.new_zeros(1), counts.cumsum(0)])
        distances = self.centres.new_empty(int(indptr[-1]))
        indices = torch.empty_like(distances, dtype=torch.int32)
        self._search(columns, 0, None, indptr.int(), distances, indices)
        values = (1 / counts.double()).repeat_interleave(counts)
        shape = len(counts), len(columns.points)
        return Binding(indptr, indices.long(), values, shape).to(like.device, like.dtype)

    def _search(self, columns: _Columns, most: int, *out: Tensor | None) -> None:
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
            most,
            *out,
        )


def _share_volumes(points: np.ndarray, volumes: np.ndarray, added: np.ndarray) -> np.ndarray:
    """Positive volumes of the particles and of those added, with the sum and the first moment of the former alone.

    Added particle m at q takes ``w_m f_mj`` from its neighbour j, where ``sum_j f_mj = 1`` and
    ``sum_j f_mj p_j = q`` (the smallest such f; negative, hence a gift, where q lies outside its
    neighbours). w_m aims at an equal share among the group, and is lowered until no particle gives more
    than ``_LARGEST_SHARE`` of its volume.
    """
    size = min(_SHARING_NEIGHBOURS, len(points))
    tree = cKDTree(points, balanced_tree=False, compact_nodes=False)  # few ask it, so that building counts
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
    # Neighbours in one plane cannot balance a particle off it: they balance its projection onto the plane, so that
    # the centre of mass moves a little, but no particle is without volume (a rollout has no use for such a one).
    off = residual > _UNBALANCED
    centre = offsets[off].mean(1)
    within = np.linalg.pinv(np.swapaxes(offsets[off] - centre[:, None], 1, 2), rcond=1e-8)
    fractions[off] = 1 / size - np.einsum("mka,ma->mk", within, centre)

    taken = np.maximum(fractions, 0.0)
    demand = np.bincount(neighbours.ravel(), taken.ravel(), minlength=len(points))
    with np.errstate(divide="ignore"):
        offer = np.where(taken > 0, (volumes / demand)[neighbours], np.inf).min(1)
    weight = np.minimum(volumes[neighbours].mean(1) * size / (size + 1), _LARGEST_SHARE * offer)
    given = np.bincount(neighbours.ravel(), (weight[:, None] * fractions).ravel(), minlength=len(points))
    return np.concatenate([volumes - given, weight])
