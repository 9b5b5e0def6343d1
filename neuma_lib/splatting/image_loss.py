"""Mean squared colour difference between rendered images and decoded files.

(``rasterizer.rasterized_error`` needs no rendered images if the compositor supports it.)
"""

import torch
from torch import Tensor

from neuma_lib.errors import InputError
from neuma_lib.splatting.observation import over_white


def mean_squared_error(images: Tensor, observed: Tensor) -> Tensor:
    """Mean squared difference of each frame over all its views, pixels and channels (paper Eq. 2), shape (T,).

    Differentiable with respect to ``images``.

    Args:
        images: rendered colours over white, float32 or float64, shape (T, V, H, W, 3).
        observed: straight-alpha RGBA as uint8, shape (T, V, H, W, 4), or floating-point values shaped like ``images``:
            colours over white, or any other channels.

    Raises:
        InputError: inconsistent shapes or devices.
    """
    check_fits(images.shape, images.device, observed)
    if observed.dtype == torch.uint8:
        observed = over_white(observed.to(images.dtype) / 255)
    return (images - observed).square().flatten(1).mean(1)


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
