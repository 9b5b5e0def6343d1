"""Loss and PSNR of rendered images, as in 3D Gaussian Splatting."""

from __future__ import annotations

import functools
import math
from collections.abc import Iterable

import torch
from torch import Tensor


def mean_psnr(views: Iterable[tuple[Tensor, Tensor]]) -> tuple[float, float]:
    """Mean PSNR [dB] over views, full frame and inside the object (alpha > 1/2); NaN without views.

    Args:
        views: squared error (H, W, 3) and alpha (H, W) of each view.
    """
    full, inside = [], []
    for error, alpha in views:
        full.append(-10 * math.log10(float(error.mean())))
        inside.append(-10 * math.log10(float(error[alpha > 0.5].mean())))
    return (sum(full) / len(full), sum(inside) / len(inside)) if full else (math.nan, math.nan)


def image_loss(pictures: Tensor, targets: Tensor, ssim_weight: float) -> Tensor:
    """(1 - w) L1 + w (1 - SSIM) of (B, H, W, 3) images, as in 3D Gaussian Splatting."""
    l1 = (pictures - targets).abs().mean()
    if ssim_weight == 0:
        return l1
    return (1 - ssim_weight) * l1 + ssim_weight * (1 - ssim_map(pictures, targets).mean())


def ssim_map(a: Tensor, b: Tensor) -> Tensor:
    """SSIM (B, 3, H, W) of (B, H, W, 3) images in [0, 1]: 11 x 11 Gaussian window, zeros outside."""
    a, b = (image.movedim(-1, 1) for image in (a, b))
    mean_a, aa, ab = _Blur.apply(torch.stack([a, a * a, a * b]))
    mean_b, bb = _Blur.apply(torch.stack([b, b * b]))  # separately, since targets have no gradient
    product, squares = mean_a * mean_b, mean_a * mean_a + mean_b * mean_b
    c1, c2 = 0.01**2, 0.03**2
    return (2 * product + c1) * (2 * (ab - product) + c2) / ((squares + c1) * (aa + bb - squares + c2))


class _Blur(torch.autograd.Function):
    """The window over maps (..., H, W). It is symmetric, so the gradient is the window over the gradient.

    The backward of torch's convolution takes several times as long, since it is not specific to such a window.
    """

    @staticmethod
    def forward(ctx, maps: Tensor) -> Tensor:
        return _blurred(maps)

    @staticmethod
    def backward(ctx, gradient: Tensor) -> Tensor:
        return _blurred(gradient)


def _blurred(maps: Tensor) -> Tensor:
    channels = maps.flatten(0, -3)[None]
    count, weights = channels.shape[1], _window(maps.dtype, maps.device)
    for shape in ((-1, 1), (1, -1)):
        kernel = weights.view(1, 1, *shape).expand(count, 1, -1, -1)
        channels = torch.nn.functional.conv2d(channels, kernel, padding="same", groups=count)
    return channels.view_as(maps)


@functools.lru_cache(maxsize=8)
def _window(dtype: torch.dtype, device: torch.device) -> Tensor:
    sigma, radius = 1.5, 5
    weights = torch.exp(-(torch.arange(-radius, radius + 1, dtype=torch.float64) ** 2) / (2 * sigma**2))
    return (weights / weights.sum()).to(device, dtype)
