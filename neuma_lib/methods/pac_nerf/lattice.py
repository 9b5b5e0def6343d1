"""Values on a regular lattice of nodes: read at points by trilinear interpolation, made from those of particles."""

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
"""Value of all channels at a node that no particle sees: as raw density, no opacity (PAC-NeRF)."""
LEAST_WEIGHT = 1e-10
"""Sum of weights up to which a node counts as empty (PAC-NeRF)."""


@dataclass(frozen=True)
class Lattice:
    """Where nodes are: two or more along each axis, corners of voxels.

    Attributes:
        origin: of node (0, 0, 0) [m].
        voxel: distance between neighbours [m].
        nodes: along each axis.
    """

    origin: tuple[float, float, float]
    voxel: float
    nodes: tuple[int, int, int]

    def __post_init__(self):
        if self.voxel <= 0 or min(self.nodes) < 2:
            raise InputError(
                f"lattice: {self.nodes} nodes {self.voxel} m apart; give two along each axis and a positive voxel"
            )

    @classmethod
    def spanning(cls, low: Tensor, high: Tensor, voxel: float) -> Lattice:
        """The lattice of multiples of the voxel that holds the points between two corners (3,) [m].

        Its nodes do not depend on the corners, only how far it reaches does.
        """
        first = torch.floor(low.detach().double() / voxel).long().tolist()
        last = torch.floor(high.detach().double() / voxel).long().tolist()
        nodes = tuple(b - a + 2 for a, b in zip(first, last, strict=True))
        return cls(tuple(voxel * a for a in first), voxel, nodes)

    @property
    def far(self) -> tuple[float, float, float]:
        """Position of the last node [m]."""
        return tuple(o + (n - 1) * self.voxel for o, n in zip(self.origin, self.nodes, strict=True))

    def points(self, like: Tensor) -> Tensor:
        """Positions of the nodes [m], (X, Y, Z, 3), with the type and device of a tensor."""
        ticks = [
            o + self.voxel * torch.arange(n, dtype=like.dtype, device=like.device)
            for o, n in zip(self.origin, self.nodes, strict=True)
        ]
        return torch.stack(torch.meshgrid(*ticks, indexing="ij"), dim=-1)

    def place(self, dtype: torch.dtype):
        """The same as kernels take it."""
        t = lattice_types(dtype)
        place = t.Place()
        place.origin, place.inv_voxel = t.vec3(*self.origin), 1.0 / self.voxel
        place.nodes = wp.vec3i(*self.nodes)
        return place


def interpolate(lattice: Lattice, values: Tensor, points: Tensor) -> Tensor:
    """Values between the nodes, differentiable with respect to those of the nodes, not to the points.

    Args:
        lattice: where the nodes are.
        values: (X, Y, Z, C) at the nodes.
        points: (M, 3) [m]; the cells at the border go on beyond it.

    Returns:
        (M, C)

    Raises:
        InputError: shapes, types or devices that do not fit.
    """
    _check("interpolate", lattice, values, points)
    return _Interpolate.apply(lattice, values.contiguous(), points.detach().contiguous())


def from_particles(lattice: Lattice, x: Tensor, features: Tensor) -> Tensor:
    """Means of the particles' features about each node, with the weights of trilinear interpolation.

    sum_p w_np f_p / sum_p w_np in each channel, and `EMPTY` at nodes that no particle sees (PAC-NeRF, Sec. 3.2).
    Differentiable with respect to features and positions.

    Args:
        lattice: where the nodes are; it holds all particles (`Lattice.spanning`).
        x: (N, 3) positions [m].
        features: (N, C).

    Returns:
        (X, Y, Z, C)

    Raises:
        InputError: shapes, types or devices that do not fit.
    """
    if features.shape[:1] != x.shape[:1] or features.dtype != x.dtype or features.device != x.device:
        raise InputError(
            f"features {tuple(features.shape)}, {features.dtype} on {features.device}, are not those of positions"
            f" {tuple(x.shape)}, {x.dtype} on {x.device}"
        )
    return _FromParticles.apply(lattice, x.contiguous(), features.contiguous())


def _check(user: str, lattice: Lattice, values: Tensor, points: Tensor) -> None:
    if tuple(values.shape[:3]) != lattice.nodes or points.ndim != 2 or points.shape[1] != 3:
        raise InputError(
            f"{user}: values {tuple(values.shape)} and points {tuple(points.shape)} do not fit a lattice of"
            f" {lattice.nodes} nodes: give (X, Y, Z, C) and (M, 3)"
        )
    if values.dtype != points.dtype or values.device != points.device:
        raise InputError(
            f"{user}: values are {values.dtype} on {values.device}, points {points.dtype} on {points.device}:"
            " give both alike"
        )


class _Interpolate(torch.autograd.Function):
    @staticmethod
    def forward(ctx, lattice, values, points):
        ctx.lattice, ctx.shape = lattice, values.shape
        ctx.save_for_backward(points)
        channels = values.shape[3]
        out = values.new_empty(len(points), channels)
        if len(points):
            place = lattice.place(values.dtype)
            launch(
                kernels(values.dtype, channels).read,
                len(points),
                place,
                values.view(-1, channels),
                points,
                out,
            )
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
        made = kernels(x.dtype, channels)
        values = features.new_zeros(*lattice.nodes, channels)
        weights = features.new_zeros(values[..., 0].numel())
        flat = values.view(-1, channels)
        launch(made.deposit, len(x), place, x, features, weights, flat)
        launch(made.normalise, len(flat), LEAST_WEIGHT, EMPTY, weights, flat)
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
            kernels(x.dtype, channels).deposit_adjoint, len(x), ctx.lattice.place(x.dtype), LEAST_WEIGHT, x, features,
            weights, values.view(-1, channels), grad.contiguous().view(-1, channels), grad_x, grad_features,
        )  # fmt: skip
        return None, grad_x, grad_features
