"""PSNR, SSIM and LPIPS between a rendered frame and the observed one.

The measures are restricted to the bounding box of the observed and predicted object plus a margin, because the white
background is the same for any prediction.
"""

from collections.abc import Mapping

import numpy as np
from skimage.metrics import structural_similarity
from torch import Tensor

from neuma_lib.errors import InputError
from neuma_lib.evaluation.lpips import LPIPS, SMALLEST

VISIBLE = 0.05  # minimum opacity of a pixel of the object
MEASURES = ("psnr", "ssim", "lpips_vgg", "lpips_alex")


def object_window(visible: np.ndarray, margin: float) -> tuple[slice, slice]:
    """Rows and columns of the compared part of an image, at least `SMALLEST` pixels each.

    Args:
        visible: pixels of the object, observed or predicted, shape (H, W).
        margin: the bounding box grows by this fraction of its longer side on each side.

    Raises:
        InputError: nothing is visible, or the image is smaller than `SMALLEST`.
    """
    if not visible.any():
        raise InputError("image metrics", "the object is neither in the observed nor in the predicted frame")
    if min(visible.shape) < SMALLEST:
        problem = f"an image of {visible.shape} pixels is smaller than {SMALLEST} a side"
        raise InputError("image metrics", problem)
    spans = [np.flatnonzero(visible.any(axis=axis)) for axis in (1, 0)]
    grow = round(margin * max(int(s[-1] - s[0]) + 1 for s in spans))
    return tuple(
        _span(int(s[0]) - grow, int(s[-1]) + 1 + grow, size)
        for s, size in zip(spans, visible.shape, strict=True)
    )


def _span(start: int, stop: int, size: int) -> slice:
    """A span inside an image of `size` pixels, widened about its middle to at least `SMALLEST`."""
    missing = max(0, SMALLEST - (stop - start))
    start, stop = max(0, start - missing // 2), min(size, stop + missing - missing // 2)
    # A part cut off at one border is added at the other.
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
    """Measures of one frame: those of `MEASURES` for which there are networks.

    Args:
        image, reference: predicted and observed colours over white in [0, 1], shape (H, W, 3).
        alpha, mask: their opacities in [0, 1], shape (H, W).
        networks: LPIPS networks by name, "alex" and "vgg".
        margin: see `object_window`.
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
        raise InputError("ssim", f"an image of {image.shape[:2]} pixels is smaller than the window of 11")
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
        raise InputError(name, f"shapes {image.shape} and {reference.shape} of the images differ")
    return image, reference
