"""Volume rendering of a lattice of raw densities and colour features along rays (Sun et al. 2022, DVGO).

Three steps: the points of each ray that count are chosen without gradient; opacity and colour there come from the
lattice by interpolation, activation and a small network, by autograd; and they are composited.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor, nn
from torch.autograd.function import once_differentiable

from neuma_lib.device import launch
from neuma_lib.errors import InputError
from neuma_lib.radiance.lattice import Lattice, interpolate
from neuma_lib.radiance.lattice_kernels import lattice_types
from neuma_lib.radiance.marching_kernels import kernels
from neuma_lib.splatting.cameras import Cameras

FEATURES = 12
"""Colour features of a node, beside its raw density."""
STEP = 0.5
"""Distance between two points of a ray [voxels]."""
INTERVAL = 0.1
"""Exponent of the transmittance of a voxel on the coarsest lattice (PAC-NeRF); it is in proportion to the voxel."""
NEAR = 0.1
"""Distance from the camera at which rays begin [m]."""
LEAST_LIGHT = 1e-7
"""A point that sends no more than this part of its light is left out, without gradient."""
END_LIGHT = 1e-3
"""A ray ends where less than this part of the light from behind would pass (DVGO)."""


@dataclass(frozen=True)
class Opacity:
    """Shifted softplus: alpha = 1 - (1 + exp(d + b))^-interval with b = log(1 / (1 - initial) - 1).

    Attributes:
        initial: opacity of raw density 0 over an interval of 1.
        base_voxel: voxel of the coarsest lattice [m], over which a ray's exponent is `INTERVAL`.
    """

    initial: float
    base_voxel: float

    @property
    def shift(self) -> float:
        return math.log(1 / (1 - self.initial) - 1)

    def __call__(self, density: Tensor, interval: float) -> Tensor:
        """Opacities of raw densities over an interval."""
        # beyond 40, softplus is its argument to round-off of float64; torch would say so from 20 on
        return -torch.expm1(-interval * nn.functional.softplus(density + self.shift, threshold=40.0))

    def ray_interval(self, voxel: float) -> float:
        """The interval of one point of a ray through voxels of this size [m]."""
        return INTERVAL * STEP * voxel / self.base_voxel


class ColourNetwork(nn.Module):
    """Features and viewing direction to a colour: three linear layers with ReLU between them, a sigmoid behind.

    Args:
        features: number of features of a point.
        width: neurons of a layer.
        frequencies: the direction comes along with sine and cosine of 2^k times it, k < frequencies.
    """

    def __init__(self, features: int = FEATURES, width: int = 128, frequencies: int = 4):
        super().__init__()
        self.register_buffer("frequencies", 2.0 ** torch.arange(frequencies), persistent=False)
        self.layers = nn.Sequential(
            nn.Linear(features + 3 + 6 * frequencies, width), nn.ReLU(),
            nn.Linear(width, width), nn.ReLU(),
            nn.Linear(width, 3),
        )  # fmt: skip
        nn.init.zeros_(self.layers[-1].bias)

    def forward(self, features: Tensor, directions: Tensor, rays: Tensor) -> Tensor:
        """Colours (M, 3) of points with features (M, C) on rays (M,) of directions (R, 3)."""
        waves = (directions[:, :, None] * self.frequencies).flatten(1)
        seen_from = torch.cat([directions, waves.sin(), waves.cos()], dim=1)
        return torch.sigmoid(self.layers(torch.cat([features, seen_from[rays]], dim=1)))


Colours = Callable[[Tensor, Tensor, Tensor], Tensor]
"""Features (M, C), directions (R, 3) and rays (M,) to colours (M, 3)."""


def camera_rays(cameras: Cameras, view: int) -> tuple[Tensor, Tensor]:
    """Origins and unit directions of the rays through the pixel centres of a view, (H W, 3) each, row by row."""
    K, viewmat = cameras.Ks[view], cameras.viewmats[view]
    kind = dict(dtype=K.dtype, device=K.device)
    y, x = torch.meshgrid(
        torch.arange(cameras.height, **kind) + 0.5, torch.arange(cameras.width, **kind) + 0.5, indexing="ij"
    )
    local = torch.stack([(x - K[0, 2]) / K[0, 0], (y - K[1, 2]) / K[1, 1], torch.ones_like(x)], dim=-1)
    directions = nn.functional.normalize(local.reshape(-1, 3) @ viewmat[:3, :3], dim=1)
    return cameras.positions[view].expand_as(directions).contiguous(), directions


def render(
    lattice: Lattice,
    values: Tensor,
    opacity: Opacity,
    colours: Colours,
    origins: Tensor,
    directions: Tensor,
    background: Sequence[float] = (1.0, 1.0, 1.0),
) -> tuple[Tensor, Tensor]:
    """Light along rays.

    Differentiable with respect to the values and to what `colours` closes over; points that are left out
    (`LEAST_LIGHT`, `END_LIGHT`) have no gradient.

    Args:
        lattice: where the nodes are.
        values: raw density and features at the nodes, (X, Y, Z, 1 + C).
        opacity: activation of the density.
        colours: network of the colours.
        origins, directions: (R, 3) starts [m] and unit directions of the rays.
        background: colour behind the lattice.

    Returns:
        colours (R, 3), and the part of the background's light that comes through, (R,)

    Raises:
        InputError: shapes, types or devices that do not fit.
    """
    if origins.shape != directions.shape or origins.dtype != values.dtype or origins.device != values.device:
        raise InputError(
            f"render: rays of shapes {tuple(origins.shape)} and {tuple(directions.shape)} ({origins.dtype} on"
            f" {origins.device}) for values of {values.dtype} on {values.device}: give all alike"
        )
    points, rays, starts = march(lattice, values[..., 0], opacity, origins, directions)
    read = interpolate(lattice, values, points)
    alphas = opacity(read[:, 0], opacity.ray_interval(lattice.voxel))
    return _Composite.apply(tuple(background), starts, alphas, colours(read[:, 1:], directions, rays))


@torch.no_grad()
def march(
    lattice: Lattice, density: Tensor, opacity: Opacity, origins: Tensor, directions: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """The points that count: positions (M, 3), their rays (M,), and where those of each ray start, (R + 1,)."""
    dtype, R = density.dtype, len(origins)
    density, origins, directions = (value.detach().contiguous() for value in (density, origins, directions))
    place, interval = lattice.place(dtype), opacity.ray_interval(lattice.voxel)
    constants = (place, NEAR, STEP * lattice.voxel, interval, opacity.shift, LEAST_LIGHT, END_LIGHT)
    counts = torch.zeros(R + 1, dtype=torch.int32, device=density.device)
    nothing = origins[:0], torch.empty(0, dtype=torch.int64, device=density.device)
    field = (density.view(-1), origins, directions)
    launch(kernels(dtype).march, R, *constants, 0, *field, counts, *nothing, counts[1:])
    starts = counts.cumsum(0, dtype=torch.int32)
    M = int(starts[-1])
    points, rays = origins.new_empty(M, 3), nothing[1].new_empty(M)
    launch(kernels(dtype).march, R, *constants, 1, *field, starts, points, rays, counts)
    return points, rays, starts


class _Composite(torch.autograd.Function):
    @staticmethod
    def forward(ctx, background, starts, alphas, colours):
        alphas, colours = alphas.detach().contiguous(), colours.detach().contiguous()
        behind = lattice_types(alphas.dtype).vec3(*background)
        R, reaching = len(starts) - 1, torch.empty_like(alphas)
        pictures, passed = alphas.new_empty(R, 3), alphas.new_empty(R)
        launch(
            kernels(alphas.dtype).composite, R, behind, starts, alphas, colours, reaching, pictures, passed
        )
        ctx.save_for_backward(starts, alphas, colours, reaching)
        ctx.behind = behind
        return pictures, passed

    @staticmethod
    @once_differentiable
    def backward(ctx, grad_pictures, grad_passed):
        starts, alphas, colours, reaching = ctx.saved_tensors
        grad_alphas, grad_colours = torch.empty_like(alphas), torch.empty_like(colours)
        launch(
            kernels(alphas.dtype).composite_adjoint, len(starts) - 1, ctx.behind, starts, alphas, colours, reaching,
            grad_pictures.contiguous(), grad_passed.contiguous(), grad_alphas, grad_colours,
        )  # fmt: skip
        return None, None, grad_alphas, grad_colours
