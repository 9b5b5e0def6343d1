"""Mass density of a body at rest: constant, or two values separated by a plane."""

from collections.abc import Mapping

import torch
from torch import Tensor

Density = float | Mapping[str, float | str]
"""A density [kg/m^3], or ``{"axis": "x", "at": 0.5, "below": 800, "above": 1200}`` (`config.SplitDensityConfig`)."""


def density_at(x: Tensor, density: Density) -> Tensor:
    """Density [kg/m^3] of a body at positions x (N, 3) [m] at t = 0, shape (N,)."""
    if not isinstance(density, Mapping):
        return torch.full_like(x[:, 0], float(density))
    side = x[:, "xyz".index(density["axis"])] < density["at"]
    below, above = (torch.full_like(x[:, 0], float(density[key])) for key in ("below", "above"))
    return torch.where(side, below, above)
