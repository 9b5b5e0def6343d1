"""Values on a regular lattice of nodes: trilinear interpolation at points, and means of values of particles."""

import math
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn.functional import embedding_bag

from neuma_lib.errors import InputError

EMPTY = -100.0
"""Value of all channels at a node without particles, which as raw density has no opacity (PAC-NeRF)."""
MIN_WEIGHT = 1e-10  # sum of weights up to which a node is empty (PAC-NeRF)


@dataclass(frozen=True)
class Lattice:
    """A regular lattice of nodes, the corners of voxels."""

    origin: tuple[float, float, float]  # position of node (0, 0, 0) [m]
    voxel: float  # distance between neighbouring nodes [m]
    nodes: tuple[int, int, int]  # number of nodes along each axis, at least two

    def __post_init__(self):
        if self.voxel <= 0 or min(self.nodes) < 2:
            problem = f"nodes = {self.nodes} must be at least 2 per axis and voxel = {self.voxel} m positive"
            raise InputError("lattice", problem)

    @classmethod
    def spanning(cls, low: Tensor, high: Tensor, voxel: float) -> "Lattice":
        """The smallest lattice with nodes at multiples of the voxel that contains two corners (3,) [m]."""
        first = torch.floor(low.detach().double() / voxel).long().tolist()
        last = torch.floor(high.detach().double() / voxel).long().tolist()
        nodes = tuple(b - a + 2 for a, b in zip(first, last, strict=True))
        return cls(tuple(voxel * a for a in first), voxel, nodes)

    @property
    def far(self) -> tuple[float, float, float]:
        """Position of the last node [m]."""
        return tuple(o + (n - 1) * self.voxel for o, n in zip(self.origin, self.nodes, strict=True))

    def points(self, like: Tensor) -> Tensor:
        """Positions of the nodes [m], (X, Y, Z, 3), with the dtype and device of ``like``."""
        ticks = [
            o + self.voxel * torch.arange(n, dtype=like.dtype, device=like.device)
            for o, n in zip(self.origin, self.nodes, strict=True)
        ]
        return torch.stack(torch.meshgrid(*ticks, indexing="ij"), dim=-1)

    def intersected(self, origins: Tensor, directions: Tensor) -> Tensor:
        """Whether rays (P, 3) from their origins on intersect the lattice, shape (P,)."""
        low, high = (torch.tensor(corner).to(origins) for corner in (self.origin, self.far))
        one, other = (low - origins) / directions, (high - origins) / directions
        first, last = torch.minimum(one, other).amax(1), torch.maximum(one, other).amin(1)
        return last > first.clamp(min=0)


def interpolate(lattice: Lattice, values: Tensor, points: Tensor) -> Tensor:
    """Interpolated values (M, C), differentiable with respect to those of the nodes, not to the points.

    Args:
        values: values at the nodes (X, Y, Z, C).
        points: positions (M, 3) [m], with linear extrapolation outside the lattice.

    Raises:
        InputError: shapes, dtypes or devices do not match.
    """
    _check(lattice, values, points)
    nodes, weights = _corners(lattice, points.detach())
    return embedding_bag(nodes, values.flatten(0, 2), per_sample_weights=weights, mode="sum")


def from_particles(lattice: Lattice, x: Tensor, features: Tensor) -> Tensor:
    """Means (X, Y, Z, C) of the features of particles at each node, with the weights of trilinear interpolation.

    sum_p w_np f_p / sum_p w_np in each channel, and `EMPTY` at nodes without particles (PAC-NeRF, Sec. 3.2).
    Differentiable with respect to features and positions.

    Args:
        lattice: positions of the nodes, which contains all particles (`Lattice.spanning`).
        x: positions (N, 3) [m].
        features: features (N, C).

    Raises:
        InputError: shapes, dtypes or devices do not match.
    """
    if features.shape[:1] != x.shape[:1] or features.dtype != x.dtype or features.device != x.device:
        raise InputError("features", f"{_kind(features)} do not match positions {_kind(x)}")
    nodes, weights = _corners(lattice, x)
    shares = weights[..., None]

    def sums(values: Tensor) -> Tensor:
        total = values.new_zeros(math.prod(lattice.nodes), values.shape[2])
        return total.index_add(0, nodes.flatten(), values.flatten(0, 1))

    with torch.no_grad():
        total = sums(shares)
        seen = total > MIN_WEIGHT
        means = torch.where(seen, sums(shares * features[:, None]) / total, EMPTY)
    # These sums are zero. Their gradient is that of the means, without the cancellation of a quotient of sums.
    offsets = sums(shares * (features[:, None] - means[nodes])) / torch.where(seen, total, math.inf)
    return (means + offsets).view(*lattice.nodes, -1)


def _corners(lattice: Lattice, x: Tensor) -> tuple[Tensor, Tensor]:
    """Indices (N, 8) of the nodes around points (N, 3), and their weights, differentiable with respect to x."""
    place = (x - x.new_tensor(lattice.origin)) / lattice.voxel
    last = torch.tensor(lattice.nodes, device=x.device) - 2
    first = torch.minimum(place.detach().floor().long().clamp(min=0), last)
    far = place - first
    near_far = torch.stack([1 - far, far])
    weights = torch.einsum("in,jn,kn->nijk", *near_far.unbind(2)).flatten(1)
    _, Y, Z = lattice.nodes
    steps = torch.tensor([Y * Z, Z, 1], device=x.device)
    corners = torch.cartesian_prod(*[torch.arange(2, device=x.device)] * 3)
    # Sums of products, because CUDA has no product of matrices of integers.
    return (first * steps).sum(-1)[:, None] + (corners * steps).sum(-1), weights


def _kind(value: Tensor) -> str:
    return f"{tuple(value.shape)} {value.dtype} on {value.device}"


def _check(lattice: Lattice, values: Tensor, points: Tensor) -> None:
    shapes_match = tuple(values.shape[:3]) == lattice.nodes and points.ndim == 2 and points.shape[1] == 3
    if not shapes_match or values.dtype != points.dtype or values.device != points.device:
        given = f"{_kind(values)} at {lattice.nodes} nodes do not match points {_kind(points)}"
        raise InputError("values", given, "Use shapes (X, Y, Z, C) and (M, 3), one dtype and one device")
