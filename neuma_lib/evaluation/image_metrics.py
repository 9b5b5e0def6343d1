"""How alike a rendered frame and the observed one are: PSNR, SSIM and LPIPS where the object is.

The white background around the object is easy to get right and would only dilute the measures. They are taken on the
bounding box of the object, observed and predicted, and a margin around it.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from skimage.metrics import structural_similarity
from torch import Tensor

from neuma_lib.errors import InputError
from neuma_lib.evaluation.lpips import LPIPS, SMALLEST

VISIBLE = 0.05
"""Opacity from which a pixel belongs to the object."""
MEASURES = ("psnr", "ssim", "lpips_vgg", "lpips_alex")


def object_window(visible: np.ndarray, margin: float) -> tuple[slice, slice]:
    """Rows and columns of the part of an image that is compared: at least `SMALLEST` pixels each, inside the image.

    Args:
        visible: pixels of the object, observed or predicted, shape (H, W).
        margin: the bounding box grows by this fraction of its longer side on each side.

    Raises:
        InputError: nothing is visible, or the image is smaller than `SMALLEST`.
    """
    if not visible.any():
        raise InputError(
            "image metrics: the object is neither in the observed frame nor in the predicted one"
        )
    if min(visible.shape) < SMALLEST:
        raise InputError(f"image metrics need images of {SMALLEST} pixels a side, not {visible.shape}")
    spans = [np.flatnonzero(visible.any(axis=axis)) for axis in (1, 0)]
    grow = round(margin * max(int(s[-1] - s[0]) + 1 for s in spans))
    return tuple(
        _span(int(s[0]) - grow, int(s[-1]) + 1 + grow, size)
        for s, size in zip(spans, visible.shape, strict=True)
    )


def _span(start: int, stop: int, size: int) -> slice:
    """The span cut to an image of `size` pixels, grown about its middle where it is shorter than `SMALLEST`."""
    missing = max(0, SMALLEST - (stop - start))
    start, stop = max(0, start - missing // 2), min(size, stop + missing - missing // 2)
    # What was cut at one border is given back at the other.
    start, stop = max(0, min(start, stop - SMALLEST)), min(size, max(stop, start + SMALLEST))
    return slice(start, stop)


def image_metrics(
    image: Tensor,
    alpha: Tensor,
    reference: Tensor,
    mask: Tensor,
    networks: Mapping[str, LPIPS],
    margin: float,
) -> dict[str, float]:
    """Measures of one frame, by the names of `MEASURES` of which there are networks.

    Args:
        image, reference: predicted and observed colours over white in [0, 1], shape (H, W, 3).
        alpha, mask: their opacities in [0, 1], shape (H, W).
        networks: "alex" and "vgg", or fewer.
        margin: as of `object_window`.
    """
    rows, columns = object_window(((alpha > VISIBLE) | (mask > VISIBLE)).cpu().numpy(), margin)
    pair = [picture[rows, columns].clamp(0, 1) for picture in (image, reference)]
    a, b = (picture.cpu().numpy() for picture in pair)
    planes = [picture.permute(2, 0, 1)[None] for picture in pair]
    return {
        "psnr": psnr(a, b),
        "ssim": ssim(a, b),
        **{f"lpips_{name}": float(network(*planes)) for name, network in networks.items()},
    }


def psnr(image: np.ndarray, reference: np.ndarray) -> float:
    """Peak signal-to-noise ratio [dB] of images in [0, 1], (H, W, 3). Raises InputError when shapes differ."""
    image, reference = _alike("psnr", image, reference)
    mse = float(((image - reference) ** 2).mean())
    return float("inf") if mse == 0 else -10.0 * np.log10(mse)


def ssim(image: np.ndarray, reference: np.ndarray) -> float:
    """Structural similarity (Wang et al. 2004, Gaussian window of sigma 1.5) of images in [0, 1], (H, W, 3).

    Raises:
        InputError: shapes differ, or a side is shorter than the window's 11 pixels.
    """
    image, reference = _alike("ssim", image, reference)
    if min(image.shape[:2]) < 11:
        raise InputError(f"ssim: an image of {image.shape[:2]} pixels is smaller than the window of 11")
    return float(
        structural_similarity(
            image,
            reference,
            channel_axis=-1,
            data_range=1.0,
            gaussian_weights=True,
            sigma=1.5,
            use_sample_covariance=False,
        )
    )


def _alike(name: str, image: np.ndarray, reference: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Both as float64. Raises InputError when their shapes differ."""
    image, reference = np.asarray(image, np.float64), np.asarray(reference, np.float64)
    if image.shape != reference.shape:
        raise InputError(f"{name}: images of shapes {image.shape} and {reference.shape} do not match")
    return image, reference
