"""Volume rendering of a lattice of raw densities and colour features along rays (Sun et al. 2022, DVGO).

Rendering has three steps: select the relevant points of each ray without gradient, compute their opacity and colour by
interpolation, activation and a small network with autograd, and composite them. The memory of autograd is proportional
to the number of points. `render_in_pieces` limits the number at a time, and `sum_of_terms` differentiates one piece
before the next is rendered.
"""

import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor, nn
from torch.autograd.function import once_differentiable

from neuma_lib.device import launch
from neuma_lib.errors import InputError
from neuma_lib.methods.pac_nerf.lattice import Lattice, interpolate
from neuma_lib.methods.pac_nerf.marching_kernels import kernels, place_of, warp_types
from neuma_lib.splatting.cameras import Cameras

FEATURES = 12  # number of colour features of a node, in addition to its raw density
STEP = 0.5  # distance between two points of a ray [voxels]
INTERVAL = 0.1
"""Exponent of the transmittance of a voxel on the coarsest lattice (PAC-NeRF), proportional to the voxel."""
NEAR = 0.1  # distance from the camera at which rays start [m]
MIN_LIGHT = 1e-7  # weight T alpha up to which a point is omitted, without gradient
END_LIGHT = 1e-3  # transmittance below which a ray ends (DVGO)
POINTS_AT_ONCE = {"cpu": 2**16, "cuda": 2**20}
"""Maximum number of points plus rays in a piece of an image, by type of device.

The gradient needs 1.1 kB per point in single precision. On a CPU the 128 activations of a layer then stay below 32 MiB,
above which the C library maps every buffer again. On a GPU an image of 800 x 800 pixels is usually one piece, which
saves launches.
"""


@dataclass(frozen=True)
class Opacity:
    """Shifted softplus: alpha = 1 - (1 + exp(d + b))^-interval with b = log(1 / (1 - initial) - 1)."""

    initial: float  # opacity of raw density 0 over an interval of 1
    base_voxel: float  # voxel of the coarsest lattice [m], over which the exponent of a ray is `INTERVAL`

    @property
    def shift(self) -> float:
        return math.log(1 / (1 - self.initial) - 1)

    def __call__(self, density: Tensor, interval: float) -> Tensor:
        """Opacities of raw densities over an interval."""
        # above 40, softplus equals its argument to round-off in float64; torch's default threshold is 20
        return -torch.expm1(-interval * nn.functional.softplus(density + self.shift, threshold=40.0))

    def ray_interval(self, voxel: float) -> float:
        """Interval of one point of a ray for a voxel size [m]."""
        return INTERVAL * STEP * voxel / self.base_voxel


class ColourNetwork(nn.Module):
    """Maps features and viewing direction to a colour: three linear layers with ReLU between them, then a sigmoid.

    Args:
        features: number of features of a point.
        width: width of the hidden layers.
    """

    def __init__(self, features: int = FEATURES, width: int = 128):
        super().__init__()
        self.register_buffer("frequencies", 2.0 ** torch.arange(4), persistent=False)
        self.layers = nn.Sequential(
            nn.Linear(features + 3 + 6 * 4, width), nn.ReLU(),
            nn.Linear(width, width), nn.ReLU(),
            nn.Linear(width, 3),
        )  # fmt: skip
        nn.init.zeros_(self.layers[-1].bias)

    def forward(self, features: Tensor, directions: Tensor, rays: Tensor) -> Tensor:
        """Colours (M, 3) of points with features (M, C) on rays (M,) of directions (R, 3)."""
        waves = (directions[:, :, None] * self.frequencies).flatten(1)
        encoded = torch.cat([directions, waves.sin(), waves.cos()], dim=1)
        return torch.sigmoid(self.layers(torch.cat([features, encoded[rays]], dim=1)))


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
    counts: Tensor | None = None,
) -> tuple[Tensor, Tensor]:
    """Render rays at once, with memory proportional to the number of their points.

    Differentiable with respect to the values and the tensors that `colours` closes over. Omitted points (`MIN_LIGHT`,
    `END_LIGHT`) have no gradient.

    Args:
        values: raw density and features at the nodes, (X, Y, Z, 1 + C).
        origins, directions: origins [m] and unit directions of the rays, (R, 3).
        counts: number of points of each ray, (R,), if known (`count_points`).

    Returns:
        Colours (R, 3) and transmittances (R,) of the rays.

    Raises:
        InputError: shapes, dtypes or devices do not match.
    """
    points, rays, starts = march(lattice, values[..., 0], opacity, origins, directions, counts)
    read = interpolate(lattice, values, points)
    alphas = opacity(read[:, 0], opacity.ray_interval(lattice.voxel))
    return _Composite.apply(tuple(background), starts, alphas, colours(read[:, 1:], directions, rays))


def render_in_pieces(
    lattice: Lattice,
    values: Tensor,
    opacity: Opacity,
    colours: Colours,
    origins: Tensor,
    directions: Tensor,
    background: Sequence[float] = (1.0, 1.0, 1.0),
) -> Iterator[tuple[slice, Tensor, Tensor]]:
    """`render` any number of rays in pieces of at most `POINTS_AT_ONCE` points and rays, or of one ray.

    The memory is that of one piece if its graph is released before the next piece is requested.

    Yields:
        Slice of the rays, their colours and their transmittances, as in `render`.
    """
    limit = POINTS_AT_ONCE[values.device.type]
    counts = count_points(lattice, values[..., 0], opacity, origins, directions)
    ends = (counts + 1).cumsum(0).cpu()
    first = done = 0
    while first < len(ends):
        last = max(first + 1, int(torch.searchsorted(ends, done + limit, right=True)))
        part = slice(first, last)
        rays = origins[part], directions[part]
        yield part, *render(lattice, values, opacity, colours, *rays, background, counts[part])
        first, done = last, int(ends[last - 1])


def sum_of_terms(terms: Callable[[Tensor], Iterable[Tensor]], values: Tensor) -> Tensor:
    """Sum of terms, differentiated term by term so that only one graph is in memory.

    Args:
        terms: function from values to an iterable of scalars that depend on no other tensor with a gradient.
        values: any shape.

    Returns:
        Scalar, differentiable with respect to the values. Terms and required gradients are computed once.
    """
    return _SumOfTerms.apply(terms, values)


@torch.no_grad()
def count_points(
    lattice: Lattice, density: Tensor, opacity: Opacity, origins: Tensor, directions: Tensor
) -> Tensor:
    """Number of selected points of each ray, (R,)."""
    counts = torch.zeros(len(origins), dtype=torch.int32, device=origins.device)
    nothing = origins[:0], torch.empty(0, dtype=torch.int64, device=origins.device)
    _march(lattice, density, opacity, origins, directions, 0, counts, *nothing, counts)
    return counts


@torch.no_grad()
def march(
    lattice: Lattice,
    density: Tensor,
    opacity: Opacity,
    origins: Tensor,
    directions: Tensor,
    counts: Tensor | None = None,
) -> tuple[Tensor, Tensor, Tensor]:
    """Selected points: positions (M, 3), their rays (M,), and the start index of each ray, (R + 1,).

    ``counts`` is the result of `count_points` if known.
    """
    if counts is None:
        counts = count_points(lattice, density, opacity, origins, directions)
    starts = nn.functional.pad(counts, (1, 0)).cumsum(0, dtype=torch.int32)
    M = int(starts[-1])
    points, rays = origins.new_empty(M, 3), torch.empty(M, dtype=torch.int64, device=origins.device)
    _march(lattice, density, opacity, origins, directions, 1, starts, points, rays, counts)
    return points, rays, starts


def _march(lattice, density, opacity, origins, directions, fill, starts, points, rays, counts) -> None:
    if (
        origins.shape != directions.shape
        or origins.dtype != density.dtype
        or origins.device != density.device
    ):
        raise InputError(
            "rays",
            f"origins {tuple(origins.shape)} and directions {tuple(directions.shape)}, {origins.dtype} on"
            f" {origins.device}, do not match each other or values of {density.dtype} on {density.device}",
        )
    density, origins, directions = (value.detach().contiguous() for value in (density, origins, directions))
    place, interval = place_of(lattice, density.dtype), opacity.ray_interval(lattice.voxel)
    constants = (place, NEAR, STEP * lattice.voxel, interval, opacity.shift, MIN_LIGHT, END_LIGHT)
    field = (density.view(-1), origins, directions)
    launch(kernels(density.dtype).march, len(origins), *constants, fill, *field, starts, points, rays, counts)


class _SumOfTerms(torch.autograd.Function):
    @staticmethod
    def forward(ctx, terms, values):
        leaf = values.detach().requires_grad_(ctx.needs_input_grad[1])
        total, grad = values.new_zeros(()), torch.zeros_like(values)
        with torch.set_grad_enabled(leaf.requires_grad):
            for term in terms(leaf):
                if leaf.requires_grad:
                    grad += torch.autograd.grad(term, leaf)[0]
                total += term.detach()
        ctx.save_for_backward(grad)
        return total

    @staticmethod
    @once_differentiable
    def backward(ctx, grad_total):
        (grad,) = ctx.saved_tensors
        return None, grad_total * grad


class _Composite(torch.autograd.Function):
    @staticmethod
    def forward(ctx, background, starts, alphas, colours):
        alphas, colours = alphas.detach().contiguous(), colours.detach().contiguous()
        behind = warp_types(alphas.dtype).vec3(*background)
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
