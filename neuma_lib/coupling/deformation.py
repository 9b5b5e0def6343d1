"""Particle-driven motion of Gaussians (paper Sec. 3.3, Particle-GS)."""

from __future__ import annotations

import torch
import warp as wp

from neuma_lib.coupling.binding import Binding
from neuma_lib.coupling.deformation_kernels import kernels
from neuma_lib.errors import InputError
from neuma_lib.splatting.arrays import matrices, plain, target, vectors


def deform(
    means: torch.Tensor,
    covars: torch.Tensor,
    binding: Binding,
    x0: torch.Tensor,
    x: torch.Tensor,
    F: torch.Tensor,
    *,
    covariance_gradient: bool = True,
) -> tuple[torch.Tensor, torch.Tensor]:
    """Move and stretch Gaussians with the particles that they are bound to.

    x_t = x_0 + B (p_t - p_0); F_bar = B F_t; A_t = F_bar A_0 F_bar^T. The first is the sum of the paper's
    increments, because B does not change. Differentiable with respect to x and F, not to what is at rest.

    Args:
        means: (G, 3) Gaussian centres at rest [m].
        covars: (G, 3, 3) covariances at rest [m^2].
        binding: B (G x N, rows sum to 1).
        x0: (N, 3) particle positions at rest [m].
        x: (T, N, 3) particle positions of the frames [m].
        F: (T, N, 3, 3) their deformation gradients.
        covariance_gradient: let image gradients reach F through the covariances. The authors' released code
            does not (its deformation kernel is not taped); False reproduces that.

    Returns:
        means (T, G, 3), covars (T, G, 3, 3)

    Raises:
        InputError: numbers of particles, Gaussians or frames that disagree.
    """
    _check_shapes(binding, means, covars, x0, x, F)
    at_rest = (value.contiguous() for value in (means, covars, x0))
    return _Deform.apply(binding, *at_rest, x, F if covariance_gradient else F.detach())


def _check_shapes(binding: Binding, means, covars, x0, x, F) -> None:
    G, N = binding.shape
    T = len(x)
    expected = {
        "means": (means, (G, 3)),
        "covars": (covars, (G, 3, 3)),
        "x0": (x0, (N, 3)),
        "x": (x, (T, N, 3)),
        "F": (F, (T, N, 3, 3)),
    }
    for name, (value, shape) in expected.items():
        if tuple(value.shape) != shape:
            raise InputError(
                f"deform: {name} has shape {tuple(value.shape)}, expected {shape} for a binding of {G} Gaussians to"
                f" {N} particles. Rerun the binding stage if either changed."
            )
        if value.dtype != x.dtype or value.device != x.device:
            raise InputError(
                f"deform: {name} is {value.dtype} on {value.device}, x is {x.dtype} on {x.device}: give both alike"
            )


class _Deform(torch.autograd.Function):
    """`deform` by the kernels of `deformation_kernels`."""

    @staticmethod
    def forward(ctx, binding: Binding, means, covars, x0, x, F):
        T, G = len(x), len(means)
        x, F = x.contiguous(), F.contiguous()
        carry, _, _ = kernels(x.dtype)
        moved, stretched = x.new_empty(T, G, 3), x.new_empty(T, G, 3, 3)
        F_bar = torch.empty_like(stretched) if ctx.needs_input_grad[5] else None
        wp.launch(
            carry,
            dim=(T, G),
            inputs=[
                *map(plain, binding.rows(x.dtype)), vectors(means), matrices(covars), vectors(x0), vectors(x),
                matrices(F),
            ],
            outputs=[vectors(moved), matrices(stretched), None if F_bar is None else matrices(F_bar)],
            **target(x),
        )  # fmt: skip
        ctx.save_for_backward(covars, F_bar)
        ctx.binding = binding
        return moved, stretched

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx, grad_moved, grad_stretched):
        covars, F_bar = ctx.saved_tensors
        T, N = len(grad_moved), ctx.binding.shape[1]
        grad_moved = grad_moved.contiguous()
        _, stretch_adjoint, carry_adjoint = kernels(grad_moved.dtype)
        grad_x, grad_F, to_F = grad_moved.new_empty(T, N, 3), None, (None, None)
        if F_bar is not None:
            grad_F_bar, grad_F = torch.empty_like(F_bar), grad_moved.new_empty(T, N, 3, 3)
            to_F = matrices(grad_F_bar), matrices(grad_F)
            wp.launch(
                stretch_adjoint,
                dim=F_bar.shape[:2],
                inputs=[matrices(covars), matrices(F_bar), matrices(grad_stretched.contiguous())],
                outputs=[to_F[0]],
                **target(grad_moved),
            )
        columns = ctx.binding.columns(grad_moved.dtype)
        wp.launch(
            carry_adjoint,
            dim=(T, N),
            inputs=[*map(plain, columns), vectors(grad_moved), to_F[0]],
            outputs=[vectors(grad_x), to_F[1]],
            **target(grad_moved),
        )
        return None, None, None, None, grad_x, grad_F
