"""Particle-driven motion of Gaussians (paper Sec. 3.3, Particle-GS)."""

import torch

from neuma_lib.coupling.binding import Binding
from neuma_lib.coupling.deformation_kernels import PARTS, kernels
from neuma_lib.device import launch
from neuma_lib.splatting.arrays import check_tensors


def deform(
    means: torch.Tensor,
    covars: torch.Tensor,
    binding: Binding,
    x0: torch.Tensor,
    x: torch.Tensor,
    F: torch.Tensor,
    *,
    arms: torch.Tensor | None = None,
    covariance_gradient: bool = True,
) -> tuple[torch.Tensor, torch.Tensor]:
    """Move and stretch Gaussians with the particles that they are bound to (paper Eq. 7 and 8).

    x_t = x_0 + B (p_t - p_0); F_bar = B F_t; A_t = F_bar A_0 F_bar^T. The first equation is the sum of the paper's
    increments, because B is constant. It is accurate for a Gaussian amid its particles. The offset a = x_0 - B p_0 of a
    Gaussian on the surface from its particles stays constant although the body rotates and stretches. With `arms` it is
    transformed too, x_t = B p_t + F_bar a, which is exact for affine motions. Differentiable with respect to x and F.

    Args:
        means: (G, 3) Gaussian centres at rest [m].
        covars: (G, 3, 3) covariances at rest [m^2].
        binding: B (G x N, rows sum to 1).
        x0: (N, 3) particle positions at rest [m].
        x: (T, N, 3) particle positions of the frames [m].
        F: (T, N, 3, 3) deformation gradients of the frames.
        arms: (G, 3) offsets a at rest [m] from `arms_at_rest`; None: the paper's equation.
        covariance_gradient: propagate gradients to F through covariances and arms. False reproduces the authors'
            released code, whose deformation kernel is not taped.

    Returns:
        means (T, G, 3), covars (T, G, 3, 3)

    Raises:
        InputError: inconsistent numbers of particles, Gaussians or frames.
    """
    T, (G, N) = len(x), binding.shape
    expected = {
        "x": (x, (T, N, 3)),
        "F": (F, (T, N, 3, 3)),
        "x0": (x0, (N, 3)),
        "means": (means, (G, 3)),
        "covars": (covars, (G, 3, 3)),
    }
    if arms is not None:
        expected["arms"], arms = (arms, (G, 3)), arms.contiguous()
    check_tensors("deform", expected, "Run the rule binding again if Gaussians or particles have changed")
    at_rest = (*(value.contiguous() for value in (means, covars, x0)), arms)
    return _Deform.apply(binding, *at_rest, x, F if covariance_gradient else F.detach())


def arms_at_rest(means: torch.Tensor, binding: Binding, x0: torch.Tensor) -> torch.Tensor:
    """Offsets from the mean of a Gaussian's particles to its centre [m], shape (G, 3); zero without particles.

    Args:
        means: (G, 3) Gaussian centres at rest [m].
        binding: B (G x N, rows sum to 1).
        x0: (N, 3) particle positions at rest [m].
    """
    covars, F = means.new_zeros(len(means), 3, 3), x0.new_zeros(1, len(x0), 3, 3)
    anchors, _ = deform(torch.zeros_like(means), covars, binding, torch.zeros_like(x0), x0[None], F)
    return torch.where(binding.counts[:, None].to(means.device) > 0, means - anchors[0], 0.0)


class _Deform(torch.autograd.Function):
    """`deform` with the kernels of `deformation_kernels`."""

    @staticmethod
    def forward(ctx, binding: Binding, means, covars, x0, arms, x, F):
        T, (G, N) = len(x), binding.shape
        moved, stretched = x.new_empty(T, G, 3), x.new_empty(T, G, 3, 3)
        run = kernels(x.dtype)
        states = torch.cat([x - x0, F.flatten(2)], dim=2).view(T, N * PARTS, 4)
        sums = x.new_empty(T, G * PARTS, 4)
        launch(run.weighted_sums, (T, G * PARTS), *binding.rows(x.dtype), states, PARTS, sums)
        results = (moved.view(T, 3 * G), stretched.view(T, 3 * G, 3))
        launch(run.carry, (T, 3 * G), means.view(-1), covars, arms, sums, *results)
        ctx.save_for_backward(covars, arms, sums if ctx.needs_input_grad[6] else None)
        ctx.binding = binding
        return moved, stretched

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx, grad_moved, grad_stretched):
        covars, arms, sums = ctx.saved_tensors
        T, (G, N) = len(grad_moved), ctx.binding.shape
        parts = 1 if sums is None else PARTS
        incoming = (grad_moved.contiguous(), grad_stretched.contiguous())
        columns = ctx.binding.columns(grad_moved.dtype)
        run = kernels(grad_moved.dtype)
        grad_sums = grad_moved.new_empty(T, G * parts, 4)
        grad_states = grad_moved.new_empty(T, N * parts, 4)
        launch(run.stretch_adjoint, (T, G), covars, arms, sums, *incoming, grad_sums)
        launch(run.weighted_sums, (T, N * parts), *columns, grad_sums, parts, grad_states)
        grad_states = grad_states.view(T, N, 4 * parts)
        grad_x = grad_states[..., :3]
        grad_F = None if sums is None else grad_states[..., 3:].unflatten(-1, (3, 3))
        return None, None, None, None, None, grad_x, grad_F
