"""Gaussians of a splat that was made elsewhere, made fit for simulation (the paper's image-to-3D experiment).

"Optionally do some post-processing to cull the isolated kernels and reduce the number of kernels": faint, oversized
and isolated Gaussians are left out, and the rest is thinned; then the object is put upright where it starts.
"""

from __future__ import annotations

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

_NEIGHBOURS = 16
"""Nearest Gaussians among which links are sought."""
_SPACING_NEIGHBOUR = 4
"""The median distance to this neighbour is the spacing."""
_TOUCHING = 2.0
"""Standard deviations along the middle axis within which Gaussians are linked: needles link nothing."""
_DECILE = 0.05
"""Part of the centres beyond either end of what counts as the object's extent, while strays are still there."""
_MORTON_BITS = 10
UP = {name: sign * np.eye(3)[axis] for axis, (up, down) in enumerate((("x", "-x"), ("y", "-y"), ("z", "-z")))
      for name, sign in ((up, 1.0), (down, -1.0))}  # fmt: skip
"""Directions by the names of axes."""


@dataclasses.dataclass(frozen=True)
class Culled:
    """How many Gaussians were left out, one reason after the other, and how many of the rest thinning has kept."""

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
    """The Gaussians of the object alone, ``count`` of them at most; arguments as in `SplatConfig`.

    Raises:
        InputError: nothing is left, with the setting that took most.
    """
    read = len(gaussians)
    opaque = gaussians.cull(min_opacity)
    if len(opaque) == 0:
        raise InputError(
            f"splat: none of {read} Gaussians is more opaque than {min_opacity}: lower min_opacity"
        )
    ends = torch.quantile(
        _sample(opaque.means.double()), torch.tensor([_DECILE, 1 - _DECILE]).double(), dim=0
    )
    longest = float((ends[1] - ends[0]).max())
    small = opaque[opaque.scales.amax(dim=1) <= max_scale * longest]
    if len(small) < _NEIGHBOURS:
        raise InputError(
            f"splat: {len(small)} of {len(opaque)} opaque Gaussians are smaller than {max_scale} of the object's size: "
            "raise max_scale"
        )
    body = small[_largest_cluster(small, reach, min_links)]
    kept = thinned(body, count, seed)
    return kept, Culled(read, read - len(opaque), len(opaque) - len(small), len(small) - len(body), len(kept))


def _sample(values: Tensor, most: int = 100_000) -> Tensor:
    """At most so many rows: torch's quantiles are of small tensors only."""
    return values[:: max(1, -(-len(values) // most))]


def _largest_cluster(gaussians: Gaussians, reach: float, min_links: int) -> Tensor:
    """Indices of the Gaussians that links join to most others, without isolated ones."""
    means, widths = gaussians.means.double().numpy(), gaussians.scales.median(dim=1).values.double().numpy()
    asked = min(_NEIGHBOURS, len(means) - 1)
    distance, index = (found[:, 1:] for found in cKDTree(means).query(means, k=asked + 1))
    spacing = float(np.median(distance[:, min(_SPACING_NEIGHBOUR, asked) - 1]))
    linked = distance <= np.maximum(reach * spacing, _TOUCHING * (widths[:, None] + widths[index]))
    settled = linked.sum(axis=1) >= min(min_links, asked)
    linked &= settled[:, None] & settled[index]
    if not linked.any():
        raise InputError("splat: every Gaussian is isolated: raise reach, or lower min_links")
    rows, columns = np.nonzero(linked)
    graph = csr_matrix((np.ones(len(rows), bool), (rows, index[rows, columns])), shape=(len(means),) * 2)
    _, labels = connected_components(graph, directed=False)
    largest = np.bincount(labels[settled]).argmax()
    return torch.from_numpy(np.flatnonzero(settled & (labels == largest)))


def thinned(gaussians: Gaussians, count: int, seed: int = 0) -> Gaussians:
    """At most ``count`` of N Gaussians, evenly over space, (N / n)^(1/3) times as large, so that they fill it still.

    One of each of n groups of neighbours along a space-filling curve is drawn, by opacity.
    """
    total = len(gaussians)
    if total <= count:
        return gaussians
    generator = np.random.default_rng(seed)
    order = morton_order(gaussians.means.double().numpy())
    weight = gaussians.opacities.double().numpy()[order]
    # the largest of Gumbel noise + log weight of a group is a draw from the group by its weights
    key = np.log(weight.clip(1e-30)) + generator.gumbel(size=total)
    group = np.arange(total) * count // total
    chosen = np.lexsort((key, group))[np.flatnonzero(np.diff(group, append=count))]
    kept = gaussians[torch.from_numpy(np.sort(order[chosen]))]
    return dataclasses.replace(kept, scales=kept.scales * (total / count) ** (1 / 3))


def morton_order(points: np.ndarray) -> np.ndarray:
    """Indices (P,) of points (P, 3) along a Z-order curve: neighbours in it are neighbours in space."""
    low, extent = points.min(axis=0), np.ptp(points, axis=0).max() or 1.0
    cells = ((points - low) / extent * (2**_MORTON_BITS - 1)).astype(np.uint32)
    code = np.zeros(len(points), np.uint32)
    for bit in range(_MORTON_BITS):
        for axis in range(3):
            code |= ((cells[:, axis] >> bit) & 1) << np.uint32(3 * bit + axis)
    return np.argsort(code, kind="stable")


def turned(gaussians: Gaussians, rotation: Tensor) -> Gaussians:
    """The Gaussians turned about the origin by a rotation (3, 3), their harmonics with them."""
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
    """Rotation (3, 3) that takes the axis ``up`` of a file to +y, and then turns by ``turn`` about it [degrees]."""
    axis = UP[up]
    if abs(axis[1]) == 1:  # y stays, or is turned over about z, so that the picture keeps its width
        stand = np.diag([axis[1], axis[1], 1.0])
    else:  # about the horizontal axis between the two: a quarter turn
        across = np.cross(axis, [0.0, 1.0, 0.0])
        stand = np.outer(across, across) + np.outer([0.0, 1.0, 0.0], axis) - np.outer(axis, [0.0, 1.0, 0.0])
    c, s = math.cos(math.radians(turn)), math.sin(math.radians(turn))
    return torch.from_numpy(np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]]) @ stand)


def placed(gaussians: Gaussians, size: float, height: float, center: tuple[float, float]) -> Gaussians:
    """The Gaussians scaled and moved: the box of their centres has its longest side ``size`` and its middle there.

    Args:
        size, height, center: as of a scene [m].
    """
    means = gaussians.means.double()
    low, high = means.amin(dim=0), means.amax(dim=0)
    factor = size / float((high - low).max())
    middle = torch.tensor([center[0], height, center[1]], dtype=torch.float64)
    moved = (means - (low + high) / 2) * factor + middle
    return dataclasses.replace(gaussians, means=moved.to(gaussians.means), scales=gaussians.scales * factor)
