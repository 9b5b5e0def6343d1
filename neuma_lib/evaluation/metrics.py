"""Measures of motion and of images (paper Sec. 4.1), and the Chamfer distance as a loss.

The Chamfer distance of two point sets is the mean squared distance to the nearest point of the other set,
summed over both directions, times 1e4. Between filled volumes it also holds a sampling floor, the distance
of two samplings of one and the same body, which falls with the density of the points: see
`neuma_lib.evaluation.motion`.
"""

from __future__ import annotations

import numpy as np
from skimage.metrics import structural_similarity
from torch import Tensor

from neuma_lib.errors import InputError


def tracer_rmse(a: Tensor, b: Tensor) -> Tensor:
    """Root mean square distance of the same points on two paths, (T, n, 3) [m] each -> (T,) [m]."""
    if a.shape != b.shape:
        raise InputError(f"tracer_rmse: paths of shapes {tuple(a.shape)} and {tuple(b.shape)} do not match")
    return (a.double() - b.double()).square().sum(-1).mean(-1).sqrt().cpu()


def psnr(image: np.ndarray, reference: np.ndarray, mask: np.ndarray | None = None) -> float:
    """Peak signal-to-noise ratio [dB] of images in [0, 1], (H, W, 3); mask (H, W) keeps the pixels that
    count.

    Raises:
        InputError: shapes differ, or the mask keeps nothing.
    """
    image, reference = np.asarray(image, np.float64), np.asarray(reference, np.float64)
    if image.shape != reference.shape:
        raise InputError(f"psnr: images of shapes {image.shape} and {reference.shape} do not match")
    error = (image - reference) ** 2
    if mask is not None:
        if not np.any(mask):
            raise InputError("psnr: the mask is empty, so no pixel can be measured")
        error = error[np.asarray(mask, bool)]
    mse = float(error.mean())
    return float("inf") if mse == 0 else -10.0 * np.log10(mse)


def ssim(image: np.ndarray, reference: np.ndarray) -> float:
    """Structural similarity (Wang et al. 2004, Gaussian window of sigma 1.5) of images in [0, 1], (H, W, 3).

    Raises:
        InputError: shapes differ, or a side is shorter than the window's 11 pixels.
    """
    image, reference = np.asarray(image, np.float64), np.asarray(reference, np.float64)
    if image.shape != reference.shape:
        raise InputError(f"ssim: images of shapes {image.shape} and {reference.shape} do not match")
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
