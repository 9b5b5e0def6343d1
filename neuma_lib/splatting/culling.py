"""Preparation of an imported splat for simulation (the paper's image-to-3D experiment).

"Optionally do some post-processing to cull the isolated kernels and reduce the number of kernels": removes faint,
oversized and isolated Gaussians, thins the rest, and rotates and moves the object to its initial position.
"""

import dataclasses
import math

import numpy as np
import torch
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree
from torch import Tensor

from neuma_lib.errors import InputError
from neuma_lib.splatting.gaussians import Gaussians, quaternions, rotations
from neuma_lib.splatting.spherical_harmonics import rotated

_NEIGHBOURS = 16  # number of nearest Gaussians that may be linked
_SPACING_NEIGHBOUR = 4  # the spacing is the median distance to this neighbour
_TOUCHING = 2.0
"""Standard deviations along the middle axis within which Gaussians are linked, so that needles do not link."""
_OUTSIDE_SHARE = 0.05
"""Fraction of the centres excluded at each end from the object's extent, which makes it robust to outliers."""
_MORTON_BITS = 10
UP = {name: sign * np.eye(3)[axis] for axis, (up, down) in enumerate((("x", "-x"), ("y", "-y"), ("z", "-z")))
      for name, sign in ((up, 1.0), (down, -1.0))}  # fmt: skip
"""Name of an axis -> direction."""


@dataclasses.dataclass(frozen=True)
class Culled:
    """Numbers of Gaussians: read, removed for each reason in turn, and kept after thinning."""

    read: int
    faint: int
    oversized: int
    isolated: int
    kept: int


def culled(
    gaussians: Gaussians,
    min_opacity: float,
    max_scale: float,
    reach: float,
    min_links: int,
    count: int,
    seed: int = 0,
) -> tuple[Gaussians, Culled]:
    """The Gaussians of the object, at most ``count``; arguments as in `SplatConfig`.

    Raises:
        InputError: no Gaussian is left; names the setting that removed them.
    """
    read = len(gaussians)
    opaque = gaussians.cull(min_opacity)
    if len(opaque) == 0:
        raise InputError("splat.min_opacity", f"all {read} Gaussians are below {min_opacity}", "Reduce it")
    shares = torch.tensor([_OUTSIDE_SHARE, 1 - _OUTSIDE_SHARE]).double()
    ends = torch.quantile(_subsampled(opaque.means.double()), shares, dim=0)
    longest = float((ends[1] - ends[0]).max())
    small = opaque[opaque.scales.amax(dim=1) <= max_scale * longest]
    if len(small) < _NEIGHBOURS:
        problem = (
            f"only {len(small)} of {len(opaque)} Gaussians are smaller than {max_scale} of the object's size"
        )
        raise InputError("splat.max_scale", problem, "Increase it")
    body = small[_largest_cluster(small, reach, min_links)]
    kept = thinned(body, count, seed)
    return kept, Culled(read, read - len(opaque), len(opaque) - len(small), len(small) - len(body), len(kept))


def _subsampled(values: Tensor, limit: int = 100_000) -> Tensor:
    """At most ``limit`` rows, because torch.quantile accepts small tensors only."""
    return values[:: max(1, -(-len(values) // limit))]


def _largest_cluster(gaussians: Gaussians, reach: float, min_links: int) -> Tensor:
    """Indices of the largest connected component of linked Gaussians, without isolated ones."""
    means, widths = gaussians.means.double().numpy(), gaussians.scales.median(dim=1).values.double().numpy()
    k = min(_NEIGHBOURS, len(means) - 1)
    distance, index = (result[:, 1:] for result in cKDTree(means).query(means, k=k + 1))
    spacing = float(np.median(distance[:, min(_SPACING_NEIGHBOUR, k) - 1]))
    linked = distance <= np.maximum(reach * spacing, _TOUCHING * (widths[:, None] + widths[index]))
    settled = linked.sum(axis=1) >= min(min_links, k)
    linked &= settled[:, None] & settled[index]
    if not linked.any():
        raise InputError("splat.reach", "all Gaussians are isolated", "Increase it or reduce min_links")
    rows, columns = np.nonzero(linked)
    graph = csr_matrix((np.ones(len(rows), bool), (rows, index[rows, columns])), shape=(len(means),) * 2)
    _, labels = connected_components(graph, directed=False)
    largest = np.bincount(labels[settled]).argmax()
    return torch.from_numpy(np.flatnonzero(settled & (labels == largest)))


def thinned(gaussians: Gaussians, count: int, seed: int = 0) -> Gaussians:
    """At most n = ``count`` of N Gaussians, evenly in space, enlarged by (N / n)^(1/3) to fill the same volume.

    Draws one Gaussian from each of n groups of neighbours along a space-filling curve, weighted by opacity.
    """
    total = len(gaussians)
    if total <= count:
        return gaussians
    generator = np.random.default_rng(seed)
    order = morton_order(gaussians.means.double().numpy())
    weight = gaussians.opacities.double().numpy()[order]
    # Gumbel-max trick: the maximum of log weight + Gumbel noise is a weighted draw
    key = np.log(weight.clip(1e-30)) + generator.gumbel(size=total)
    group = np.arange(total) * count // total
    chosen = np.lexsort((key, group))[np.flatnonzero(np.diff(group, append=count))]
    kept = gaussians[torch.from_numpy(np.sort(order[chosen]))]
    return dataclasses.replace(kept, scales=kept.scales * (total / count) ** (1 / 3))


def morton_order(points: np.ndarray) -> np.ndarray:
    """Indices (P,) of points (P, 3) along a Z-order curve, whose neighbours are neighbours in space."""
    low, extent = points.min(axis=0), np.ptp(points, axis=0).max() or 1.0
    cells = ((points - low) / extent * (2**_MORTON_BITS - 1)).astype(np.uint32)
    code = np.zeros(len(points), np.uint32)
    for bit in range(_MORTON_BITS):
        for axis in range(3):
            code |= ((cells[:, axis] >> bit) & 1) << np.uint32(3 * bit + axis)
    return np.argsort(code, kind="stable")


def turned(gaussians: Gaussians, rotation: Tensor) -> Gaussians:
    """The Gaussians rotated about the origin by a rotation (3, 3), including their harmonics."""
    R = rotation.to(gaussians.means)
    sh = rotated(gaussians.sh(), R)
    return dataclasses.replace(
        gaussians,
        means=gaussians.means @ R.T,
        quats=quaternions(R @ rotations(gaussians.quats)),
        sh0=sh[:, :1],
        shN=sh[:, 1:],
    )


def upright(up: str, turn: float) -> Tensor:
    """Rotation (3, 3) that maps the axis ``up`` of a file to +y, followed by ``turn`` about y [degrees]."""
    axis = UP[up]
    if abs(axis[1]) == 1:  # identity, or half a turn about z
        stand = np.diag([axis[1], axis[1], 1.0])
    else:  # a quarter turn about the horizontal axis normal to both
        across = np.cross(axis, [0.0, 1.0, 0.0])
        stand = np.outer(across, across) + np.outer([0.0, 1.0, 0.0], axis) - np.outer(axis, [0.0, 1.0, 0.0])
    c, s = math.cos(math.radians(turn)), math.sin(math.radians(turn))
    return torch.from_numpy(np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]]) @ stand)


def placed(gaussians: Gaussians, size: float, height: float, center: tuple[float, float]) -> Gaussians:
    """The Gaussians scaled and moved so that the bounding box of their centres has a given longest side and centre.

    Args:
        size: longest side [m].
        height: y of the centre [m].
        center: x and z of the centre [m].
    """
    means = gaussians.means.double()
    low, high = means.amin(dim=0), means.amax(dim=0)
    factor = size / float((high - low).max())
    middle = torch.tensor([center[0], height, center[1]], dtype=torch.float64)
    moved = (means - (low + high) / 2) * factor + middle
    return dataclasses.replace(gaussians, means=moved.to(gaussians.means), scales=gaussians.scales * factor)
