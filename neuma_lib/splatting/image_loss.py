"""Mean squared colour difference between rendered images and decoded files, without copies of either.

The observed pixels stay as decoded, four bytes each. The kernels composite them over white. One pass reads both images
for the loss, another reads them again and writes the gradient. (``rasterizer.rasterized_error`` needs no rendered
images if the compositor supports it.)
"""

# No `from __future__ import annotations` here: Warp reads the annotations of kernels as objects.
import functools

import torch
import warp as wp
from torch import Tensor

from neuma_lib.device import launch, start_warp
from neuma_lib.errors import InputError

start_warp()

_GPU_LANES = 4096
"""Partial sums of a frame on a GPU, for coalesced reads and enough threads for few frames."""


def mean_squared_error(images: Tensor, observed: Tensor) -> Tensor:
    """Mean squared difference of each frame over all its views, pixels and channels (paper Eq. 2), shape (T,).

    Differentiable with respect to ``images``. Sums are computed in double precision in a fixed order, so the result is
    deterministic.

    Args:
        images: rendered colours over white, float32 or float64, shape (T, V, H, W, 3).
        observed: straight-alpha RGBA as uint8, shape (T, V, H, W, 4), or floating-point values shaped like ``images``:
            colours over white, or any other channels.

    Raises:
        InputError: inconsistent shapes or devices.
    """
    check_fits(images.shape, images.device, observed)
    if observed.dtype != torch.uint8:
        return (images - observed).square().flatten(1).mean(1)
    return _SquaredError.apply(images, observed)


def check_fits(shape: tuple[int, ...], device: torch.device, observed: Tensor) -> None:
    """Raise InputError unless images rendered on a device, (T, V, H, W, C), can be compared with observed ones."""
    if observed.device != device:
        raise InputError("image loss: observed", f"is on {observed.device}, but renders are on {device}")
    if observed.shape != ((*shape[:-1], 4) if observed.dtype == torch.uint8 else shape):
        problem = f"has shape {tuple(observed.shape)}, but rendered images have {tuple(shape)}"
        raise InputError("image loss: observed", problem)


def as_integers(observed: Tensor) -> Tensor:
    """Straight-alpha bytes (..., 4) as one int32 per pixel (...), R in the lowest byte."""
    return observed.contiguous().view(torch.int32)[..., 0]


class _SquaredError(torch.autograd.Function):
    @staticmethod
    def forward(ctx, images: Tensor, observed: Tensor) -> Tensor:
        images, observed = images.contiguous(), observed.contiguous()
        T, pixels = len(images), images[0].numel() // 3
        lanes = 1 if images.device.type == "cpu" else min(_GPU_LANES, pixels)
        sums = images.new_empty(T, lanes, dtype=torch.float64)
        squared_error, _ = kernels(images.dtype)
        launch(squared_error, (T, lanes), *_pair(images, observed), sums)
        ctx.save_for_backward(images, observed)
        ctx.lanes = lanes
        return (sums.sum(1) / (3 * pixels)).to(images.dtype)

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx, grad: Tensor) -> tuple[Tensor, None]:
        images, observed = ctx.saved_tensors
        grad_images = torch.empty_like(images)
        scale = grad * (2 * len(images) / images.numel())
        _, adjoint = kernels(images.dtype)
        to_images = grad_images.view(len(images), -1, 3)
        launch(adjoint, (len(images), ctx.lanes), *_pair(images, observed), scale, ctx.lanes, to_images)
        return grad_images, None


def _pair(images: Tensor, observed: Tensor) -> tuple[Tensor, Tensor]:
    """Colours (T, P, 3), and pixels (T, P) as integers."""
    return images.view(len(images), -1, 3), as_integers(observed).view(len(observed), -1)


@functools.cache
def kernels(dtype: torch.dtype):
    """``(squared_error, squared_error_adjoint)`` of a dtype, over (T, lanes); a lane processes every lanes-th pixel."""
    real = wp.dtype_from_torch(dtype)
    vec3 = wp.types.vector(3, real)
    module = wp.get_module(f"{__name__}.{str(dtype).removeprefix('torch.')}")
    kernel = functools.partial(wp.kernel, enable_backward=False, module=module)

    @wp.func(module=module)
    def over_white(pixel: wp.int32):
        """Colour over white of a straight-alpha pixel, with bytes R, G, B, A from the lowest up."""
        rgba, unit, byte = wp.uint32(pixel), real(1.0) / real(255.0), wp.uint32(255)
        alpha = unit * real(rgba >> wp.uint32(24))
        red = unit * real(rgba & byte)
        green = unit * real((rgba >> wp.uint32(8)) & byte)
        blue = unit * real((rgba >> wp.uint32(16)) & byte)
        light = real(1.0) - alpha
        return vec3(red * alpha + light, green * alpha + light, blue * alpha + light)

    @kernel
    def squared_error(
        images: wp.array2d(dtype=vec3),  # (T, P)
        observed: wp.array2d(dtype=wp.int32),  # (T, P)
        sums: wp.array2d(dtype=wp.float64),  # (T, lanes), out
    ):
        t, lane = wp.tid()
        total = wp.float64(0.0)
        for p in range(lane, images.shape[1], sums.shape[1]):
            error = images[t, p] - over_white(observed[t, p])
            total += wp.float64(wp.dot(error, error))
        sums[t, lane] = total

    @kernel
    def squared_error_adjoint(
        images: wp.array2d(dtype=vec3),  # (T, P)
        observed: wp.array2d(dtype=wp.int32),  # (T, P)
        scale: wp.array(dtype=real),  # (T,)
        lanes: int,
        grad: wp.array2d(dtype=vec3),  # (T, P), out
    ):
        t, lane = wp.tid()
        for p in range(lane, images.shape[1], lanes):
            grad[t, p] = scale[t] * (images[t, p] - over_white(observed[t, p]))

    return squared_error, squared_error_adjoint
