"""Gaussian-particle binding: Algorithm 1 of the paper as a sparse matrix.

Row i of the binding matrix B (G, N) holds the weights of the particles that carry Gaussian i, so that Gaussians follow
the particles by ``x_t = x_0 + B (p_t - p_0)`` and ``F_bar = B F`` (paper, section 3.3). The dense matrix is never
formed, and the ellipsoid test touches only particles near each Gaussian.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import torch
from scipy.spatial import cKDTree
from scipy.special import chdtri
from torch import Tensor

from neuma_lib.config.binding import BindingConfig
from neuma_lib.coupling.binding import Binding
from neuma_lib.errors import InputError

_CHUNK_ENTRIES = 500_000
"""Gaussian-particle pairs looked at at one time, which bounds the memory of a search whatever its input."""
_FLATTEST = 1e-12
"""Least eigenvalue of a covariance, relative to its largest one."""
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
        particles: particle positions [m], shape (N, 3).
        settings: confidence of the ellipsoid and most particles in a row; None for the defaults.

    Returns:
        Binding of shape (G, N) on the device and with the dtype of ``means``; rows may be empty.

    Raises:
        InputError: shapes that do not fit, non-finite values, a covariance that is not positive definite.
    """
    centres, shapes, points = _checked(means, covars, particles)
    rows, columns = _pairs_inside(centres, shapes, points, settings or BindingConfig())
    return _binding_from_pairs(rows, columns, (len(centres), len(points)), means)


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
    rows, columns = _pairs_inside(centres, shapes, points, settings)
    orphans = np.flatnonzero(np.bincount(rows, minlength=len(centres)) == 0)
    added = centres[orphans]

    if len(orphans):
        # An added particle may lie inside its neighbours' ellipsoids as well.
        rows, columns = _pairs_inside(centres, shapes, np.concatenate([points, added]), settings)
        if settings.equal_mass:
            shares = np.full(len(points) + len(added), shares.sum() / (len(points) + len(added)))
        else:
            shares = _share_volumes(points, shares, added)
    count = len(points) + len(orphans)
    enlarged = torch.cat([particles, means[torch.as_tensor(orphans, device=means.device)].to(particles)])
    return (
        _binding_from_pairs(rows, columns, (len(centres), count), means),
        enlarged,
        len(orphans),
        torch.as_tensor(shares, dtype=particles.dtype, device=particles.device),
    )


def _checked(means: Tensor, covars: Tensor, particles: Tensor) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Inputs in float64 on the CPU, after checks of shapes and finiteness."""
    if means.ndim != 2 or means.shape[1] != 3 or covars.shape != (len(means), 3, 3):
        raise InputError(
            f"binding: Gaussian means {tuple(means.shape)} and covariances {tuple(covars.shape)} must be "
            "(G, 3) and (G, 3, 3)"
        )
    if particles.ndim != 2 or particles.shape[1] != 3 or len(particles) == 0:
        raise InputError(f"binding: particles {tuple(particles.shape)} must be (N, 3) with N > 0")
    arrays = []
    for name, values in (("Gaussian mean", means), ("Gaussian covariance", covars), ("particle", particles)):
        array = values.detach().to("cpu", torch.float64).numpy()
        finite = np.isfinite(array).reshape(len(array), -1).all(1)
        if not finite.all():
            raise InputError(
                f"binding: {name} {int(np.argmin(finite))} is not finite; rerun the stage that made it"
            )
        arrays.append(array)
    return arrays[0], arrays[1], arrays[2]


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


def _whitening(shapes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Maps W with ``|W d|^2 = d^T A^-1 d``, and the largest eigenvalue of each covariance."""
    eigenvalues, eigenvectors = np.linalg.eigh(shapes)
    largest = eigenvalues[:, 2]
    if not (largest > 0).all():
        worst = int(np.argmin(largest))
        raise InputError(
            f"binding: the covariance of Gaussian {worst} is not positive definite; rerun the gaussians stage"
        )
    # A disc fitted flat has a third axis at round-off: its floor keeps the inverse finite.
    eigenvalues = np.maximum(eigenvalues, _FLATTEST * largest[:, None])
    return np.swapaxes(eigenvectors, 1, 2) / np.sqrt(eigenvalues)[:, :, None], largest


def _threshold(settings: BindingConfig) -> float:
    """Largest squared Mahalanobis distance of a bound particle."""
    return float(chdtri(3, 1.0 - settings.confidence))


def _pairs_inside(
    centres: np.ndarray, shapes: np.ndarray, points: np.ndarray, settings: BindingConfig
) -> tuple[np.ndarray, np.ndarray]:
    """All pairs (Gaussian, particle) of Algorithm 1, sorted by Gaussian, then by particle.

    A Gaussian looks at the particles in those cells of a grid that the box of its ellipsoid meets, so that it costs no
    more where others are many: splats have discs and needles many times longer than they are thick.
    """
    threshold, most = _threshold(settings), settings.max_neighbours
    whitening, largest = _whitening(shapes)
    variances = np.diagonal(shapes, axis1=1, axis2=2) + _FLATTEST * largest[:, None]
    half = np.sqrt(threshold * variances) * (1 + 1e-9)
    cells = _Cells(points)
    found_rows: list[np.ndarray] = []
    found_columns: list[np.ndarray] = []
    for near, first, last in cells.runs(centres - half, centres + half):
        rows, columns, distances = [], [], []
        for some in _parts(last - first):
            begun, size = first[some], (last - first)[some]
            pair = np.repeat(near[some], size)
            place = np.arange(size.sum()) + np.repeat(begun - (np.cumsum(size) - size), size)
            offset = cells.points[place] - centres[pair]
            distance = np.zeros(len(pair))
            for axis in range(3):  # the thinnest one first: discs leave most particles out
                distance += np.square(np.einsum("pb,pb->p", whitening[pair, axis], offset))
                inside = distance <= threshold
                pair, place, offset, distance = (a[inside] for a in (pair, place, offset, distance))
            rows.append(pair)
            columns.append(cells.order[place])
            distances.append(distance)
        pair, column, distance = map(np.concatenate, (rows, columns, distances))
        if most is not None:
            # Stable in (distance, index): the particle index breaks ties.
            order = np.lexsort((column, distance, pair))
            pair, column = pair[order], column[order]
            begins = np.flatnonzero(np.diff(pair, prepend=-1))
            rank = np.arange(len(pair)) - np.repeat(begins, np.diff(begins, append=len(pair)))
            pair, column = pair[rank < most], column[rank < most]
        found_rows.append(pair)
        found_columns.append(column)
    rows = np.concatenate(found_rows) if found_rows else np.empty(0, np.int64)
    columns = np.concatenate(found_columns) if found_columns else np.empty(0, np.int64)
    order = np.lexsort((columns, rows))
    return rows[order], columns[order]


class _Cells:
    """Points (N, 3) in the order of the cubic cells of a grid, those of a column along z one after the other.

    Attributes:
        order: indices of the points, (N,).
        points: the points in that order.
    """

    def __init__(self, points: np.ndarray):
        self._lower, extent = points.min(axis=0), np.ptp(points, axis=0)
        # points in a body or on its surface: some to a few in a cell that is not empty
        self._side = float(extent.max()) / max(1, round(0.5 * np.sqrt(len(points)))) or 1.0
        self._counts = self._cell(points.max(axis=0)) + 1
        keys = self._key(self._cell(points))
        self.order = np.argsort(keys, kind="stable")
        self.points, self._keys = points[self.order], keys[self.order]

    def _cell(self, positions: np.ndarray) -> np.ndarray:
        return np.floor((positions - self._lower) / self._side).clip(-1, 2**31).astype(np.int64)

    def _key(self, cell: np.ndarray) -> np.ndarray:
        return (cell[..., 0] * self._counts[1] + cell[..., 1]) * self._counts[2] + cell[..., 2]

    def runs(
        self, lower: np.ndarray, upper: np.ndarray
    ) -> Iterator[tuple[np.ndarray, np.ndarray, np.ndarray]]:
        """Runs of points in the columns of cells that boxes (G, 3) to (G, 3) meet, some whole boxes at a time.

        Yields:
            index of the box, first point and last point but one of each run that is not empty.
        """
        first = np.maximum(self._cell(lower), 0)
        spans = np.maximum(np.minimum(self._cell(upper), self._counts - 1) - first + 1, 0)
        columns = np.where(spans[:, 2] > 0, spans[:, 0] * spans[:, 1], 0)
        for boxes in _parts(columns):
            count = columns[boxes]
            box = np.repeat(np.arange(boxes.start, boxes.stop), count)
            among = np.arange(len(box)) - np.repeat(np.cumsum(count) - count, count)
            cell = first[box]
            cell[:, 0] += among // spans[box, 1]
            cell[:, 1] += among % spans[box, 1]
            key = self._key(cell)
            begins = np.searchsorted(self._keys, key)
            ends = np.searchsorted(self._keys, key + spans[box, 2])
            met = ends > begins
            if met.any():
                yield box[met], begins[met], ends[met]


def _parts(sizes: np.ndarray) -> Iterator[slice]:
    """Slices of entries that follow each other, whose sizes sum up to at most `_CHUNK_ENTRIES`, or one entry."""
    ends = np.cumsum(sizes)
    start = 0
    while start < len(sizes):
        before = ends[start - 1] if start else 0
        stop = max(start + 1, int(np.searchsorted(ends, before + _CHUNK_ENTRIES, side="right")))
        yield slice(start, stop)
        start = stop


def _binding_from_pairs(
    rows: np.ndarray, columns: np.ndarray, shape: tuple[int, int], like: Tensor
) -> Binding:
    counts = np.bincount(rows, minlength=shape[0])
    indptr = np.concatenate([[0], np.cumsum(counts)])
    values = 1.0 / counts[rows]
    return Binding(
        torch.as_tensor(indptr, dtype=torch.int64, device=like.device),
        torch.as_tensor(columns, dtype=torch.int64, device=like.device),
        torch.as_tensor(values, dtype=like.dtype, device=like.device),
        shape,
    )


def _share_volumes(points: np.ndarray, volumes: np.ndarray, added: np.ndarray) -> np.ndarray:
    """Positive volumes of the particles and of those added, with the sum and the first moment of the former alone.

    Added particle m at q takes ``w_m f_mj`` from its neighbour j, where ``sum_j f_mj = 1`` and
    ``sum_j f_mj p_j = q`` (the smallest such f; negative, hence a gift, where q lies outside its
    neighbours). w_m aims at an equal share among the group, and is lowered until no particle gives more
    than ``_LARGEST_SHARE`` of its volume.
    """
    size = min(_SHARING_NEIGHBOURS, len(points))
    _, neighbours = cKDTree(points).query(added, k=np.arange(1, size + 1))
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
