"""Measures of motion and of images (paper Sec. 4.1); the Chamfer distance is in `neuma_lib.geometry.chamfer`."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from skimage.metrics import structural_similarity
from torch import Tensor

from neuma_lib.errors import InputError


def tracer_errors(a: Tensor, b: Tensor) -> dict:
    """How far the same points are apart on two paths, (T, n, 3) [m] each, in numbers for ``metrics.json`` [mm].

    Returns:
        ``tracer_rmse_mm``, root mean square distance over all points and frames; ``tracer_error_p95_mm``, the distance
        that 95 % of them, again over all points and frames, stay below (linear interpolation);
        ``tracer_rmse_last_mm``, root mean square over the points of the last frame; ``tracer_rmse_mm_per_frame``.

    Raises:
        InputError: shapes differ.
    """
    if a.shape != b.shape:
        raise InputError(f"tracer_errors: paths of shapes {tuple(a.shape)} and {tuple(b.shape)} do not match")
    distance = 1e3 * (a.double() - b.double()).norm(dim=-1).cpu()
    per_frame = distance.square().mean(-1).sqrt()
    return {
        "tracer_rmse_mm": float(per_frame.square().mean().sqrt()),
        "tracer_error_p95_mm": float(np.quantile(distance.numpy(), 0.95)),
        "tracer_rmse_last_mm": float(per_frame[-1]),
        "tracer_rmse_mm_per_frame": per_frame.tolist(),
    }


def mechanical_energy(x: Tensor, v: Tensor, mass: Tensor, gravity: Sequence[float]) -> Tensor:
    """Kinetic and gravitational energy [J] at T times, of particles at x [m] with velocities v [m/s], (T, N, 3) each.

    Args:
        mass: of the particles [kg], shape (N,).
        gravity: acceleration [m/s^2]; its potential is zero at the lowest point of the unit cube.

    Returns:
        shape (T,), float64. Elastic energy and the rotation inside particles, which are never negative, are left out.
    """
    g = torch.tensor(gravity, dtype=torch.float64, device=x.device)
    potential = g.clamp(min=0).sum() - x.double() @ g  # [J/kg]
    return (0.5 * v.double().square().sum(-1) + potential) @ mass.double()


def mean_height(x: np.ndarray | Tensor, mass: np.ndarray | Tensor) -> list[float]:
    """Height of the centre of mass [m] at T times, of particles x (T, N, 3) [m] of masses (N,)."""
    mass = np.asarray(mass, np.float64)
    return (np.asarray(x, np.float64)[..., 1] @ (mass / mass.sum())).tolist()


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
