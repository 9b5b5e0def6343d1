"""What the compositors share. A compositor is a module with two functions over the splats of I images:

``composite(splats, depths, background, settings, empty)``
    returns the pictures (I, H, W, 3), the alphas (I, H, W) and a tuple of tensors kept for the adjoint;
``composite_adjoint(splats, kept, background, settings, grad_pictures, grad_alphas, grad_splats, empty)``
    writes the gradients (I, G, SPLAT_SIZE) of every splat that was not culled; those of the others mean nothing.

One that compares pictures with what was observed as it draws them, and keeps none, has two more:

``compare(splats, depths, background, settings, observed, empty)``
    takes straight-alpha RGBA (I, H, W) as int32, R the lowest byte, and returns sums of squared differences from it
    over white, float64 (I, parts), an image's in as many parts as suit, and a tuple of tensors kept for the adjoint;
``compare_adjoint(splats, kept, background, settings, scales, opacities, grad_splats)``
    writes, like ``composite_adjoint``, the gradients of half of these sums, times the scale (I,) of each image; those
    with respect to the opacities mean nothing unless ``opacities`` asks for them.

``splats`` and ``depths`` are as ``projection`` writes them, ``empty(name, shape, like, dtype)`` allocates.
"""

from __future__ import annotations

import dataclasses

import torch

from neuma_lib.splatting.projection import CULLED


@dataclasses.dataclass(frozen=True)
class Settings:
    """Image size [px], thresholds and blur [px^2] of ``rasterizer.rasterize``."""

    width: int
    height: int
    alpha_min: float
    alpha_max: float
    transmittance_min: float
    eps2d: float


def depth_order(depths: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Splats of every image from near to far (I, G), and how many of them are not culled (I,)."""
    return torch.argsort(depths, dim=1, stable=True), (depths < CULLED).sum(dim=1)
