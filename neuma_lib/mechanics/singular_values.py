"""Batched singular value decomposition and rotation of 3x3 matrices, with an adjoint that is accurate at F = I.

F = U diag(sigma) Vh with det U = det V = +1, |sigma| descending, and the sign of det F in the last singular value. At
equal singular values, as in any undeformed body, U and V are not smooth, but R = U Vh and symmetric functions of sigma
are. Gradients are therefore taken only through R and sigma.

Warp's ``svd3`` is not used because it takes three times as long on a CPU for 2,000 matrices, and its adjoint has an
error of 26 % at F = I (``benchmarks/singular_values.py``, results in ``docs/results/speed.md``).
"""

import torch
from torch import Tensor

from neuma_lib.device import launch
from neuma_lib.mechanics.singular_values_kernels import CPU_WIDTH, pack_count, svd_kernel


def svd3(F: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """U (N, 3, 3), sigma (N, 3) and Vh (N, 3, 3) of F (N, 3, 3) to round-off, without gradient, in the convention of
    this module."""
    F = F.detach().contiguous()
    U, sigma, Vh = torch.empty_like(F), F.new_empty(F.shape[:-1]), torch.empty_like(F)
    if len(F):
        launch(svd_kernel(F.dtype), pack_count(len(F), F.device, CPU_WIDTH[F.dtype]), F, U, sigma, Vh, len(F))
    return U, sigma, Vh


def away_from_zero(x: Tensor, floor: Tensor | float) -> Tensor:
    """x with its magnitude raised to at least ``floor`` (zero counts as positive)."""
    return torch.where(x < 0, x.clamp(max=-floor), x.clamp(min=floor))


class _RotationAndSingularValues(torch.autograd.Function):
    """F -> (R, sigma).

    With dF' = U^T dF V, d sigma = diag dF' and dR = U K' Vh with K'_ij = (dF'_ij - dF'_ji) / (sigma_i + sigma_j),
    without differences of singular values. The quotient is bounded where sigma_i + sigma_j = 0 (an element inverted
    along two axes), where R is singular.
    """

    @staticmethod
    def forward(ctx, F):
        U, sigma, Vh = svd3(F)
        ctx.save_for_backward(U, sigma, Vh)
        return U @ Vh, sigma

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx, grad_R, grad_sigma):
        U, sigma, Vh = ctx.saved_tensors
        M = U.mT @ grad_R @ Vh.mT
        floor = torch.finfo(sigma.dtype).eps ** 0.5
        total = away_from_zero(sigma[:, :, None] + sigma[:, None, :], floor)
        K = (M - M.mT) / total + torch.diag_embed(grad_sigma)
        return U @ K @ Vh


def rotation_and_singular_values(F: Tensor) -> tuple[Tensor, Tensor]:
    """Rotation R (N, 3, 3) and singular values (N, 3) of F (N, 3, 3), differentiable once.

    The gradient of symmetric functions of sigma is exact everywhere, that of a single sigma only where it is distinct.
    """
    return _RotationAndSingularValues.apply(F)
