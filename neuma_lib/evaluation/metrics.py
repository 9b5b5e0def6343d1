"""Measures of motion (paper Sec. 4.1). The Chamfer distance is in `neuma_lib.geometry.chamfer`."""

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from neuma_lib.errors import InputError


def tracer_errors(a: Tensor, b: Tensor) -> dict:
    """Distances between the same points on two paths, (T, n, 3) [m] each, as numbers for ``metrics.json`` [mm].

    Returns:
        ``tracer_rmse_mm`` and ``tracer_error_p95_mm``, root mean square and 95th percentile (linear interpolation) over
        all points and frames; ``tracer_rmse_last_mm``, root mean square in the last frame;
        ``tracer_rmse_mm_per_frame``.

    Raises:
        InputError: shapes differ.
    """
    if a.shape != b.shape:
        raise InputError("tracer_errors", f"shapes {tuple(a.shape)} and {tuple(b.shape)} of the paths differ")
    distance = 1e3 * (a.double() - b.double()).norm(dim=-1).cpu()
    per_frame = distance.square().mean(-1).sqrt()
    return {
        "tracer_rmse_mm": float(per_frame.square().mean().sqrt()),
        "tracer_error_p95_mm": float(np.quantile(distance.numpy(), 0.95)),
        "tracer_rmse_last_mm": float(per_frame[-1]),
        "tracer_rmse_mm_per_frame": per_frame.tolist(),
    }


def mechanical_energy(x: Tensor, v: Tensor, mass: Tensor, gravity: Sequence[float]) -> Tensor:
    """Kinetic and gravitational energy [J] of particles at x [m] with velocities v [m/s], (T, N, 3) each.

    Args:
        mass: of the particles [kg], shape (N,).
        gravity: acceleration [m/s^2]. Its potential is zero at the lowest point of the unit cube.

    Returns:
        shape (T,), float64. Elastic and rotational energy of the particles, never negative, are not included.
    """
    g = torch.tensor(gravity, dtype=torch.float64, device=x.device)
    potential = g.clamp(min=0).sum() - x.double() @ g  # [J/kg]
    return (0.5 * v.double().square().sum(-1) + potential) @ mass.double()


def mean_height(x: np.ndarray | Tensor, mass: np.ndarray | Tensor) -> list[float]:
    """Height of the centre of mass [m] at T times, of particles x (T, N, 3) [m] of masses (N,)."""
    mass = np.asarray(mass, np.float64)
    return (np.asarray(x, np.float64)[..., 1] @ (mass / mass.sum())).tolist()
