"""Measures of motion (paper Sec. 4.1); the Chamfer distance is in `neuma_lib.geometry.chamfer`."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
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
