"""Tests of a material point: stress of a law under prescribed deformations."""

from dataclasses import dataclass

import torch
from torch import Tensor

from neuma_lib.mechanics.law import Constitutive, Law

OUTER = 0.005  # share of the visited states that is ignored at each end of a range, as outliers
_COMPRESSED = 0.05  # quantile of the volume ratio at which shear is tested
_NEWTON_STEPS, _LARGEST_STEP, _DIFFERENCE = 30, 0.05, 1e-6
"""Parameters of the search for traction-free sides, in stretches."""


@dataclass(frozen=True)
class Visited:
    """Elastic states of a motion.

    Attributes:
        stretch: range of the principal stretches.
        shear: range of the elastic shear, the amount gamma of the simple shear with the same ratio of largest and
            smallest stretch, with both signs.
        pressed: 5th percentile of the volume ratio J, at most 1. Shear in an impact is mostly compressed.
    """

    stretch: tuple[float, float]
    shear: tuple[float, float]
    pressed: float

    @classmethod
    def of(cls, F: Tensor) -> "Visited":
        """Ranges of elastic deformation gradients F (..., 3, 3)."""
        sigma = torch.linalg.svdvals(F.reshape(-1, 3, 3).double())
        J = torch.linalg.det(F.reshape(-1, 3, 3).double())
        ratio = (sigma[:, 0] / sigma[:, 2].clamp(min=1e-6)).sqrt()
        # gamma of F = [[1, gamma], [0, 1]]: its stretches are s and 1 / s with s - 1 / s = gamma.
        shear = _quantile(ratio - 1 / ratio, 1 - 2 * OUTER)
        return cls(
            stretch=(_quantile(sigma[:, 2], OUTER), _quantile(sigma[:, 0], 1 - OUTER)),
            shear=(-shear, shear),
            pressed=min(_quantile(J, _COMPRESSED), 1.0),
        )


def largest_shear_stress(law: Law, F: Tensor) -> float:
    """Largest shear stress of a law in visited elastic states F (..., 3, 3), without outliers [Pa]."""
    tau = stress(law, F.reshape(-1, 3, 3).double())
    principal = torch.linalg.eigvalsh(0.5 * (tau + tau.mT))
    return _quantile(0.5 * (principal[:, 2] - principal[:, 0]), 1 - OUTER)


def uniaxial(law: Law, stretch: Tensor) -> Tensor:
    """Axial Kirchhoff stress [Pa] (n,) of the elastic law for axial stretches (n,) with traction-free sides.

    The two lateral stretches are equal, with zero mean lateral stress. They are followed from stretch 1 outwards, so
    that a law with several equilibria stays on the branch of the undeformed state.
    """
    axial = torch.empty_like(stretch)
    order = (stretch - 1).abs().argsort().tolist()
    lateral = {True: 1.0, False: 1.0}  # at the last point in tension and in compression
    for index in order:
        tension = bool(stretch[index] > 1)
        lateral[tension], axial[index] = _free_sides(law, float(stretch[index]), lateral[tension])
    return axial


def _free_sides(law: Law, axial: float, lateral: float) -> tuple[float, Tensor]:
    """Lateral stretch without lateral stress, by Newton's method from ``lateral``, and the axial stress there [Pa]."""
    for _ in range(_NEWTON_STEPS):
        pair = torch.tensor([lateral, lateral + _DIFFERENCE], dtype=torch.float64)
        F = torch.diag_embed(torch.stack([pair, torch.full_like(pair, axial), pair], dim=1))
        tau = stress(law, F)
        side = 0.5 * (tau[:, 0, 0] + tau[:, 2, 2])
        slope = (side[1] - side[0]) / _DIFFERENCE
        step = float(side[0] / slope) if float(slope) > 0 else 0.0
        if abs(step) < _DIFFERENCE:
            break
        lateral -= max(-_LARGEST_STEP, min(_LARGEST_STEP, step))
    return lateral, tau[0, 1, 1]


def sheared(law: Law, shear: Tensor, J: float = 1.0) -> Tensor:
    """Kirchhoff shear stress [Pa] (n,) of the elastic law for simple shears (n,) at the volume ratio J."""
    F = torch.eye(3, dtype=shear.dtype).repeat(len(shear), 1, 1)
    F[:, 0, 1] = shear
    return stress(law, J ** (1 / 3) * F)[:, 0, 1]


def yielding(law: Law, rate: float, dt: float, steps: int, J: float = 1.0) -> Tensor:
    """Simple shear at a constant rate with elastic law and return map, step by step as in a simulation.

    Args:
        rate: of shear [1/s].
        dt: time step [s].
        steps: number n of steps.
        J: initial volume ratio.

    Returns:
        Shear Kirchhoff stress [Pa] at the total shears 0, rate dt, ..., n rate dt, shape (n + 1,).
    """
    F = J ** (1 / 3) * torch.eye(3, dtype=torch.float64)[None]
    increment = torch.eye(3, dtype=torch.float64)
    increment[0, 1] = rate * dt
    stresses = [stress(law, F)[0, 0, 1]]
    for _ in range(steps):
        F = returned(law, increment @ F)
        stresses.append(stress(law, F)[0, 0, 1])
    return torch.stack(stresses)


def stress(law: Law, F: Tensor) -> Tensor:
    """Kirchhoff stress [Pa] of the elastic law in float64, (N, 3, 3), for deformation gradients F (N, 3, 3)."""
    return _value(law.elasticity, F)


def returned(law: Law, F_trial: Tensor) -> Tensor:
    """Elastic deformation gradients after the return map in float64, (N, 3, 3), of trial ones (N, 3, 3)."""
    return _value(law.plasticity, F_trial)


def _value(part: Constitutive, F: Tensor) -> Tensor:
    with torch.no_grad():
        return part.evaluate(F, tuple(w.detach().double() for w in part.weights()))


def _quantile(values: Tensor, q: float) -> float:
    """`torch.quantile` without its limit on the number of values."""
    return float(values.sort().values[round(q * (len(values) - 1))])
