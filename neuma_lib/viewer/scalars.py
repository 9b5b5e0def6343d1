"""Scalars that colour particles: speed, stress, plastic strain, volume ratio, with ranges for a legend in SI units."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass

import numpy as np
import torch
from scipy.spatial import cKDTree
from torch import Tensor

from neuma_lib.mechanics.law import Law

_PERCENTILE = 99.5  # upper end of a legend, robust to single detached particles
_NEIGHBOURS = 16  # number of nearest particles in the fit of a deformation gradient


@dataclass(frozen=True)
class Quantity:
    """A quantity: label and unit for the legend, value at the centre of its range (or None), minimum range."""

    label: str
    unit: str
    middle: float | None
    min_range: float


QUANTITIES = {
    "speed": Quantity("speed", "m/s", None, 0.01),
    "von_mises": Quantity("von Mises stress", "Pa", None, 1.0),
    "plastic_strain": Quantity("equivalent plastic strain", "", None, 0.01),
    "volume_ratio": Quantity("elastic volume ratio det F", "", 1.0, 1e-3),
}


def speed(x: Tensor, times: Tensor, v: Tensor | None = None) -> Tensor:
    """Speeds (T, N) [m/s] from velocities v (T, N, 3), or by differences of positions (T, N, 3) at times (T,)."""
    if v is None:
        if len(times) == 1:
            return x.new_zeros(x.shape[:2])
        (v,) = torch.gradient(x, spacing=(times.to(x),), dim=0)
    return v.norm(dim=-1)


def von_mises(law: Law, F: Tensor) -> Tensor:
    """Von Mises stress sqrt(3/2 s : s) [Pa] of elastic F (..., 3, 3), s the deviator of the Cauchy stress tau / det F.

    The symmetric part is used, because the stress of a network need not be symmetric.
    """
    flat = F.reshape(-1, 3, 3)
    with torch.no_grad():
        tau = law.elasticity.evaluate(flat, law.elasticity.weights())
    sigma = 0.5 * (tau + tau.mT) / torch.linalg.det(flat)[:, None, None]
    mean = sigma.diagonal(dim1=-2, dim2=-1).mean(dim=-1)
    s = sigma - mean[:, None, None] * torch.eye(3, dtype=F.dtype, device=F.device)
    return (1.5 * s.square().sum(dim=(-2, -1))).sqrt().reshape(F.shape[:-2])


def volume_ratio(F: Tensor) -> Tensor:
    """det F of elastic deformation gradients (..., 3, 3)."""
    return torch.linalg.det(F)


def plastic_strain(F: Tensor, total: Tensor) -> Tensor:
    """Equivalent plastic strain sqrt(2/3) |dev log sigma_p|, sigma_p the stretches of F_p = F^-1 F_total.

    Args:
        F, total: elastic and total deformation gradients, (..., 3, 3). Where F is singular, the strain is 0.
    """
    plastic, singular = torch.linalg.solve_ex(F, total)
    plastic = torch.where(singular[..., None, None] != 0, 0.0, plastic).nan_to_num(0.0, 0.0, 0.0)
    stretches = torch.linalg.svdvals(plastic).clamp_min(1e-6)
    logs = stretches.log()
    deviator = logs - logs.mean(dim=-1, keepdim=True)
    return (2 / 3 * deviator.square().sum(dim=-1)).sqrt()


def total_deformation(x: Tensor) -> Tensor:
    """Total deformation gradients (T, N, 3, 3) estimated from positions (T, N, 3).

    Least-squares fit of an affine map to the motion of a particle's nearest neighbours in the first frame: exact for
    affine motions, else an average over about two particle spacings.
    """
    x0 = x[0].double()
    count = min(_NEIGHBOURS + 1, len(x0))
    _, near = cKDTree(x0.numpy()).query(x0.numpy(), k=np.arange(1, count + 1))
    near = torch.from_numpy(near)
    rest = x0[near] - x0[near].mean(dim=1, keepdim=True)
    inverse = torch.linalg.pinv(rest.mT @ rest)
    gradients = []
    for now in x.double():
        moved = now[near] - now[near].mean(dim=1, keepdim=True)
        gradients.append((moved.mT @ rest @ inverse).to(x.dtype))
    return torch.stack(gradients)


def ranges(motions: Iterable[Mapping[str, Tensor]]) -> dict[str, tuple[float, float]]:
    """Common legend range of all motions for every quantity, in round numbers.

    The range is the median over the motions, which is robust to a diverged one.
    """
    motions = list(motions)
    result = {}
    for name, quantity in QUANTITIES.items():
        values = [own[name].reshape(-1) for own in motions if name in own]
        if not values:
            continue
        middle = quantity.middle or 0.0
        ends = [float(np.percentile((v - middle).abs().numpy(), _PERCENTILE)) for v in values]
        reach = rounded_up(max(sorted(ends)[len(ends) // 2], quantity.min_range))
        result[name] = (middle - reach if quantity.middle is not None else 0.0, middle + reach)
    return result


def rounded_up(value: float) -> float:
    """Round a positive value up to 1, 1.5, 2, 3, 4, 5, 6, 8 or 10 times a power of ten."""
    power = 10.0 ** np.floor(np.log10(value))
    steps = (1, 1.5, 2, 3, 4, 5, 6, 8, 10)
    return float(next(step for step in steps if step * power >= value * (1 - 1e-9)) * power)
