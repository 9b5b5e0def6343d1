"""The two interfaces that analytic and neural constitutive laws share.

A material model of the paper (Sec. 3.2) is a pair: an *elasticity*, from the deformation gradient to a stress, and a
*plasticity*, which projects the trial deformation gradient back to the admissible elastic region. Both have an adjoint
that is called by hand, so that a rollout is differentiated by one explicit reverse loop without an autograd graph.

The weights are an argument: the rollout asks for them once (``law.weights()``, where LoRA is merged), uses the same
tensors at every step and returns their gradients to autograd once.
"""

from __future__ import annotations

from collections.abc import Hashable
from typing import Any, Literal

import torch
from torch import Tensor, nn

from neuma_lib.errors import NonFiniteError

Weights = tuple[Tensor, ...]
AdjointPrecision = Literal["single", "half"]


class Constitutive(nn.Module):
    """A pointwise map of deformation gradients, (N, 3, 3) -> (N, 3, 3), differentiable in F and its weights.

    A subclass writes :meth:`response` in differentiable torch, and may override the rest with faster code.
    """

    capturable = False
    """Whether `evaluate` and `vjp` can be recorded in a CUDA graph: no read from the device, all scratch reused."""
    adjoint_precision: AdjointPrecision = "single"
    """Of the matrix products in `vjp`: "half" takes factors of 11 bits where a law has such kernels, and sums them in
    float32; elsewhere it changes nothing."""

    def graph_key(self) -> Hashable:
        """Equal for laws that do the same with the same weights, so that they can share recorded graphs."""
        return self

    def weights(self) -> Weights:
        """Tensors that a rollout differentiates, as a differentiable function of the parameters; () if all is fixed."""
        return ()

    def response(self, F: Tensor, weights: Weights) -> Tensor:
        """The law itself, in differentiable torch. F (N, 3, 3) -> (N, 3, 3)."""
        raise NotImplementedError

    def forward(self, F: Tensor) -> Tensor:
        """Differentiable evaluation with the module's own weights (regression, tests)."""
        return self.response(F, self.weights())

    def evaluate(self, F: Tensor, weights: Weights, out: Tensor | None = None) -> Tensor:
        """The law without gradient; ``out`` (N, 3, 3), not an alias of F, receives the result if given."""
        with torch.no_grad():
            value = self.response(F, weights)
        return value if out is None else out.copy_(value)

    def evaluate_with_cache(
        self, F: Tensor, weights: Weights, out: Tensor | None = None, cache: Any = None
    ) -> tuple[Tensor, Any]:
        """As `evaluate`, and an opaque cache that spares `vjp` the recomputation; None where a law keeps nothing.

        The cache owns its memory, so that several can be kept. One that is no longer needed can be given back as
        `cache`, for as many rows, to be filled again.
        """
        return self.evaluate(F, weights, out), None

    def vjp(
        self,
        F: Tensor,
        weights: Weights,
        grad_out: Tensor,
        cache: Any = None,
        grad_F: Tensor | None = None,
        grad_weights: Weights | None = None,
    ) -> tuple[Tensor, Weights]:
        """Vector-Jacobian product at F.

        Args:
            F, weights: as given to :meth:`evaluate`.
            grad_out: (N, 3, 3) gradient of a scalar with respect to the result.
            cache: from :meth:`evaluate_with_cache` at the same F and weights; None recomputes.
            grad_F: (N, 3, 3) buffer that receives the first result if given.
            grad_weights: accumulators shaped as the weights, or what :meth:`accumulators` made of them; if given, the
                gradients are added to them.

        Returns:
            the gradient with respect to F, and one gradient a weight (the accumulators if they were given).
        """
        with torch.enable_grad():
            leaves = [F.detach().requires_grad_(), *(w.detach().requires_grad_() for w in weights)]
            value = self.response(leaves[0], tuple(leaves[1:]))
            if value.requires_grad:
                grads = torch.autograd.grad(value, leaves, grad_out, allow_unused=True)
            else:
                grads = (None,) * len(leaves)
        grads = [torch.zeros_like(leaf) if g is None else g for g, leaf in zip(grads, leaves, strict=True)]
        result = grads[0] if grad_F is None else grad_F.copy_(grads[0])
        if grad_weights is None:
            return result, tuple(grads[1:])
        for total, grad in zip(grad_weights, grads[1:], strict=True):
            total.add_(grad)
        return result, grad_weights

    def accumulators(self, F: Tensor, grad_weights: Weights) -> Weights:
        """What many calls of `vjp`, each for as many rows as F (N, 3, 3), add to at the least cost, zero at the start;
        `add_up` has the last word. By default the accumulators ``grad_weights`` themselves.
        """
        return grad_weights

    def add_up(self, accumulators: Weights, grad_weights: Weights) -> None:
        """Add to ``grad_weights`` what ``accumulators``, of :meth:`accumulators`, have received."""


class Elasticity(Constitutive):
    """Deformation gradient F -> Kirchhoff stress tau = P F^T [Pa], both (N, 3, 3)."""


class Plasticity(Constitutive):
    """Trial deformation gradient F_trial -> elastic deformation gradient F, both (N, 3, 3)."""


class Law(nn.Module):
    """A material model: elasticity and plasticity, with a name for messages."""

    def __init__(self, elasticity: Elasticity, plasticity: Plasticity, name: str = "law"):
        super().__init__()
        self.elasticity = elasticity
        self.plasticity = plasticity
        self.name = name

    def weights(self) -> tuple[Weights, Weights]:
        """Weights of the elasticity and of the plasticity."""
        return self.elasticity.weights(), self.plasticity.weights()

    def set_adjoint_precision(self, precision: AdjointPrecision) -> None:
        """Compute gradients in :attr:`Constitutive.adjoint_precision` from now on, in both parts."""
        for part in (self.elasticity, self.plasticity):
            part.adjoint_precision = precision

    def longitudinal_modulus(self) -> float:
        """Largest eigenvalue of the acoustic tensor Q_ik = n_j (d tau_ij / d F_kl) n_l at F = I over n [Pa].

        For an isotropic law this is the P-wave modulus, lam + 2 mu. Measured by one-sided differences in float64 along
        26 directions n (a neural law need not be isotropic, and sorted singular values have a kink at F = I).
        """
        step = 1e-5
        ticks = torch.tensor([-1.0, 0.0, 1.0], dtype=torch.float64)
        n = torch.cartesian_prod(ticks, ticks, ticks)
        n = n[n.norm(dim=1) > 0]
        n = n / n.norm(dim=1, keepdim=True)
        eye = torch.eye(3, dtype=torch.float64)
        H = torch.einsum("ka,dl->dakl", eye, n)  # displacement gradient e_a (x) n of direction d
        F = torch.cat([eye + step * H.reshape(-1, 3, 3), eye[None]])
        weights = self.elasticity.weights()
        device = weights[0].device if weights else torch.device("cpu")
        tau = self.elasticity.evaluate(F.to(device), tuple(w.detach().double() for w in weights)).cpu()
        tangent = ((tau[:-1] - tau[-1]) / step).reshape(len(n), 3, 3, 3)
        Q = torch.einsum("daij,dj->dia", tangent, n)
        if not torch.isfinite(Q).all():
            raise NonFiniteError("wave speed", f"the tangent of law {self.name!r} at F = I is not finite")
        return float(torch.linalg.eigvalsh(0.5 * (Q + Q.mT)).max())

    def wave_speed(self, rho: float) -> float:
        """Speed of the fastest small elastic wave about F = I [m/s], for density rho [kg/m^3]."""
        return max(self.longitudinal_modulus(), 0.0) ** 0.5 / rho**0.5
