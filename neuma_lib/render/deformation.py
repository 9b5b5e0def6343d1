"""Particle-driven motion of Gaussian kernels (paper Sec. 3.3, Particle-GS)."""

from __future__ import annotations

from typing import Protocol

import torch


class AppliesToParticles(Protocol):
    """The part of a binding that is used here: rows average the particles bound to each Gaussian."""

    def apply(self, field: torch.Tensor) -> torch.Tensor: ...


def deform(
    means: torch.Tensor,
    covars: torch.Tensor,
    binding: AppliesToParticles,
    x0: torch.Tensor,
    x: torch.Tensor,
    F: torch.Tensor,
    *,
    covariance_gradient: bool = True,
) -> tuple[torch.Tensor, torch.Tensor]:
    """Move and stretch Gaussians with the particles that they are bound to.

    x_t = x_0 + B (p_t - p_0); F_bar = B F_t; A_t = F_bar A_0 F_bar^T. The first is the sum of the paper's
    increments, because B does not change.

    Args:
        means: (G, 3) Gaussian centres at rest [m].
        covars: (G, 3, 3) covariances at rest [m^2].
        binding: B (G x N, rows sum to 1), anything with ``apply((T, N, ...)) -> (T, G, ...)``.
        x0: (N, 3) particle positions at rest [m].
        x: (T, N, 3) particle positions of the frames [m].
        F: (T, N, 3, 3) their deformation gradients.
        covariance_gradient: let image gradients reach F through the covariances. The authors' released code
            does not (its deformation kernel is not taped); False reproduces that.

    Returns:
        means (T, G, 3), covars (T, G, 3, 3)
    """
    moved = means + binding.apply(x - x0)
    F_bar = binding.apply(F if covariance_gradient else F.detach())
    return moved, F_bar @ covars @ F_bar.mT
