"""Values on a regular lattice of nodes: trilinear interpolation at points, and means of values of particles."""

from __future__ import annotations

from dataclasses import dataclass

import torch
import warp as wp
from torch import Tensor
from torch.autograd.function import once_differentiable

from neuma_lib.device import launch
from neuma_lib.errors import InputError
from neuma_lib.methods.pac_nerf.lattice_kernels import kernels, lattice_types

EMPTY = -100.0
"""Value of all channels at a node without particles, which as raw density has no opacity (PAC-NeRF)."""
MIN_WEIGHT = 1e-10
"""Sum of weights up to which a node is empty (PAC-NeRF)."""


@dataclass(frozen=True)
class Lattice:
    """A regular lattice of nodes, the corners of voxels.

    Attributes:
        origin: position of node (0, 0, 0) [m].
        voxel: distance between neighbouring nodes [m].
        nodes: number of nodes along each axis, at least two.
    """

    origin: tuple[float, float, float]
    voxel: float
    nodes: tuple[int, int, int]

    def __post_init__(self):
        if self.voxel <= 0 or min(self.nodes) < 2:
            raise InputError(
                "lattice",
                f"nodes = {self.nodes} must be at least 2 per axis and voxel = {self.voxel} m positive",
            )

    @classmethod
    def spanning(cls, low: Tensor, high: Tensor, voxel: float) -> Lattice:
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

    def place(self, dtype: torch.dtype):
        """The lattice as a struct for kernels."""
        t = lattice_types(dtype)
        place = t.Place()
        place.origin, place.inv_voxel = t.vec3(*self.origin), 1.0 / self.voxel
        place.nodes = wp.vec3i(*self.nodes)
        return place


def interpolate(lattice: Lattice, values: Tensor, points: Tensor) -> Tensor:
    """Interpolated values (M, C), differentiable with respect to those of the nodes, not to the points.

    Args:
        lattice: positions of the nodes.
        values: values at the nodes (X, Y, Z, C).
        points: positions (M, 3) [m], with linear extrapolation outside the lattice.

    Raises:
        InputError: shapes, dtypes or devices do not match.
    """
    _check(lattice, values, points)
    return _Interpolate.apply(lattice, values.contiguous(), points.detach().contiguous())


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
    return _FromParticles.apply(lattice, x.contiguous(), features.contiguous())


def _kind(value: Tensor) -> str:
    return f"{tuple(value.shape)} {value.dtype} on {value.device}"


def _check(lattice: Lattice, values: Tensor, points: Tensor) -> None:
    shapes_match = tuple(values.shape[:3]) == lattice.nodes and points.ndim == 2 and points.shape[1] == 3
    if not shapes_match or values.dtype != points.dtype or values.device != points.device:
        given = f"{_kind(values)} at {lattice.nodes} nodes do not match points {_kind(points)}"
        raise InputError("values", given, "Use shapes (X, Y, Z, C) and (M, 3), one dtype and one device")


class _Interpolate(torch.autograd.Function):
    @staticmethod
    def forward(ctx, lattice, values, points):
        ctx.lattice, ctx.shape = lattice, values.shape
        ctx.save_for_backward(points)
        channels = values.shape[3]
        out = values.new_empty(len(points), channels)
        if len(points):
            kernel, place = kernels(values.dtype, channels).read, lattice.place(values.dtype)
            launch(kernel, len(points), place, values.view(-1, channels), points, out)
        return out

    @staticmethod
    @once_differentiable
    def backward(ctx, grad):
        (points,) = ctx.saved_tensors
        channels, grad = ctx.shape[3], grad.contiguous()
        grad_values = grad.new_zeros(ctx.shape)
        if len(points):
            place = ctx.lattice.place(grad.dtype)
            kernel = kernels(grad.dtype, channels).read_adjoint
            launch(kernel, len(points), place, points, grad, grad_values.view(-1, channels))
        return None, grad_values, None


class _FromParticles(torch.autograd.Function):
    @staticmethod
    def forward(ctx, lattice, x, features):
        x, features = x.detach(), features.detach()
        channels, place = features.shape[1], lattice.place(x.dtype)
        k = kernels(x.dtype, channels)
        values = features.new_zeros(*lattice.nodes, channels)
        weights = features.new_zeros(values[..., 0].numel())
        flat = values.view(-1, channels)
        launch(k.deposit, len(x), place, x, features, weights, flat)
        launch(k.normalise, len(flat), MIN_WEIGHT, EMPTY, weights, flat)
        ctx.lattice = lattice
        ctx.save_for_backward(x, features, weights, values)
        return values

    @staticmethod
    @once_differentiable
    def backward(ctx, grad):
        x, features, weights, values = ctx.saved_tensors
        channels = features.shape[1]
        grad_x, grad_features = torch.empty_like(x), torch.empty_like(features)
        launch(
            kernels(x.dtype, channels).deposit_adjoint, len(x), ctx.lattice.place(x.dtype), MIN_WEIGHT, x, features,
            weights, values.view(-1, channels), grad.contiguous().view(-1, channels), grad_x, grad_features,
        )  # fmt: skip
        return None, grad_x, grad_features
