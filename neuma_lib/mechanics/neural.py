"""Neural constitutive laws (NCLaw, Ma et al. 2023): the paper's M_0, optionally with an adaptor Delta M.

A network of three layers without bias, 13 -> 64 -> 64 -> 9 with GELU activations, maps the rotation-invariant features
(sigma - 1, F^T F - I, det F - 1) to an output whose symmetric part X gives

- elasticity: P = R X, tau = P F^T;
- plasticity: F = F_trial + 1e-3 R X.

Zero features give zero output because there is no bias, so rotations are stress-free. R makes both maps objective.

:mod:`neural_vector` has faster kernels for a CPU and :mod:`neural_fused` for float32 on recent GPUs. This module covers
all other cases and is the reference implementation of those kernels.
"""

from __future__ import annotations

import threading
from collections.abc import Hashable

import torch
from torch import Tensor
from torch.nn.functional import gelu, pad

from neuma_lib.device import launch
from neuma_lib.errors import InputError
from neuma_lib.mechanics import neural_fused, neural_vector
from neuma_lib.mechanics.adaptor import AdaptableConstitutive, AdaptableLaw, layers_of
from neuma_lib.mechanics.law import Elasticity, Plasticity, Weights
from neuma_lib.mechanics.neural_kernels import FEATURES, feature_kernel, output_kernels
from neuma_lib.mechanics.singular_values import rotation_and_singular_values
from neuma_lib.mechanics.singular_values_kernels import CPU_WIDTH, pack_count

WIDTH = 64
SHAPES = ((WIDTH, FEATURES), (WIDTH, WIDTH), (9, WIDTH))
PLASTIC_SCALE = 1e-3
PADDED = 16
"""Columns of the gradient of the features. BLAS is four times faster with 16 than with 13."""

aten = torch.ops.aten


def features(F: Tensor, sigma: Tensor) -> Tensor:
    """(N, 13) features of F (N, 3, 3) with singular values sigma (N, 3); differentiable torch."""
    eye = torch.eye(3, dtype=F.dtype, device=F.device)
    gram = (F.mT @ F - eye).reshape(-1, 9)
    return torch.cat([sigma - 1, gram, torch.linalg.det(F)[:, None] - 1], dim=1)


class _Forward:
    """Intermediate values of a forward pass over the rows F (n, 3, 3), for the adjoint."""

    def __init__(self, F: Tensor):
        n = len(F)
        self.z = F.new_empty(n, FEATURES)
        self.R, self.Vh, self.Y = (torch.empty_like(F) for _ in range(3))
        self.a0, self.h0, self.a1, self.h1 = (F.new_empty(n, WIDTH) for _ in range(4))


class _Backward:
    """Scratch memory of the adjoint over the rows F. grad_z has padding columns."""

    def __init__(self, F: Tensor):
        n = len(F)
        self.grad_Y = torch.empty_like(F)
        self.grad_h, self.grad_a = F.new_empty(n, WIDTH), F.new_empty(n, WIDTH)
        self.grad_z = F.new_empty(n, PADDED)


class _Scratch(threading.local):
    """Reused buffers by (kind, rows, dtype, device), one set per thread."""

    def __init__(self):
        self.buffers: dict[tuple, _Forward | _Backward] = {}

    def get(self, kind: type, F: Tensor):
        key = (kind, len(F), F.dtype, F.device)
        if key not in self.buffers:
            if len(self.buffers) > 32:  # recorded graphs hold the addresses of buffers on a GPU
                self.buffers = {k: buffer for k, buffer in self.buffers.items() if k[-1].type != "cpu"}
            self.buffers[key] = kind(F)
        return self.buffers[key]


_scratch = _Scratch()


class NeuralConstitutive(AdaptableConstitutive):
    """A network with frozen base weights and an optional adaptor: M = M_0 + Delta M (paper Eq. 3)."""

    kind: str
    scale: float
    capturable = True
    native = True
    keeps_singular_values = True
    fused: bool | None = None
    """Whether evaluate and vjp use :mod:`neural_fused` or :mod:`neural_vector`: False never, True always, None where
    these are supported."""

    @property
    def loops(self) -> bool:
        return self.fused is not False

    def graph_key(self) -> Hashable:
        return type(self), self.fused, self.adjoint_precision

    def __init__(self, weights: Weights | None = None, seed: int = 0):
        """Args: weights: three matrices of :data:`SHAPES`, by default Xavier-uniform from ``seed``."""
        super().__init__()
        if weights is None:
            generator = torch.Generator().manual_seed(seed)
            bounds = [(6 / sum(shape)) ** 0.5 for shape in SHAPES]
            weights = tuple(
                (2 * torch.rand(s, generator=generator) - 1) * b for s, b in zip(SHAPES, bounds, strict=True)
            )
        shapes = tuple(tuple(w.shape) for w in weights)
        if shapes != SHAPES:
            raise InputError(f"{self.kind} weights", f"shapes {shapes} must be {SHAPES}")
        self.freeze(weights)

    def response(self, F: Tensor, weights: Weights) -> Tensor:
        R, sigma = rotation_and_singular_values(F)
        W0, W1, W2 = weights
        Y = (gelu(gelu(features(F, sigma) @ W0.mT) @ W1.mT) @ W2.mT).reshape(-1, 3, 3)
        X = 0.5 * (Y + Y.mT)
        return R @ X @ F.mT if self.kind == "elasticity" else F + self.scale * (R @ X)

    def uses_fused(self, F: Tensor) -> bool:
        """Whether fused kernels evaluate F, depending on its device, its dtype and :attr:`fused`."""
        kernels = neural_vector if F.device.type == "cpu" else neural_fused
        return kernels.supported(F.device, F.dtype) if self.fused is None else self.fused

    def evaluate(self, F: Tensor, weights: Weights, out: Tensor | None = None) -> Tensor:
        if not self.uses_fused(F):
            return self._evaluate(F, weights, out)
        kernels = neural_vector if F.device.type == "cpu" else neural_fused
        return kernels.evaluate(F, weights, self.kind, self.scale, out)

    def evaluate_with_cache(self, F, weights, out=None, cache=None):
        if not self.uses_fused(F):
            cache = cache or _Forward(F)
            return self._evaluate(F, weights, out, cache), cache
        if F.device.type != "cpu":
            return self.evaluate(F, weights, out), None
        cache = F.new_empty(self.cache_shape(F, weights)) if cache is None else cache
        return neural_vector.evaluate(F, weights, self.kind, self.scale, out, cache), cache

    def kernel(self, F, weights, backward):
        return neural_vector.kernel_of(self.kind, self.scale, F, weights, backward)

    def cache_shape(self, F, weights):
        return neural_vector.cache_shape(F)

    @torch.no_grad()
    def _evaluate(self, F, weights, out, state=None):
        F = F.detach().contiguous()
        out = torch.empty_like(F) if out is None else out
        result, _, _ = output_kernels(F.dtype, self.kind)
        if len(F):
            state = state or _scratch.get(_Forward, F)
            self._network(F, weights, state)
            launch(result, len(F), F, state.R, state.Y, self.scale, out)
        return out

    def _network(self, F: Tensor, weights: Weights, state: _Forward) -> None:
        """Fill ``state`` from the rows F."""
        packs = pack_count(len(F), F.device, CPU_WIDTH[F.dtype])
        launch(feature_kernel(F.dtype), packs, F, state.z, state.R, state.Vh, len(F))
        W0, W1, W2 = weights
        torch.mm(state.z, W0.mT, out=state.a0)
        aten.gelu.out(state.a0, out=state.h0)
        torch.mm(state.h0, W1.mT, out=state.a1)
        aten.gelu.out(state.a1, out=state.h1)
        torch.mm(state.h1, W2.mT, out=state.Y.view(-1, 9))

    def accumulators(self, F, grad_weights):
        sums_blocks = F.device.type != "cpu" and self.uses_fused(F)
        return (neural_fused.partial_sums(F),) if sums_blocks else grad_weights

    @torch.no_grad()
    def add_up(self, accumulators, weights, grad_weights):
        if len(accumulators) != len(grad_weights):
            neural_fused.add_up(*accumulators, grad_weights)

    @torch.no_grad()
    def vjp(self, F, weights, grad_out, cache=None, grad_F=None, grad_weights=None):
        if self.uses_fused(F):
            if F.device.type == "cpu":
                grads = (cache, grad_F, grad_weights)
                return neural_vector.vjp(F, weights, grad_out, self.kind, self.scale, *grads)
            grads = (grad_F, grad_weights, self.adjoint_precision)
            return neural_fused.vjp(F, weights, grad_out, self.kind, self.scale, *grads)
        F, g = F.detach().contiguous(), grad_out.contiguous()
        weights = tuple(w.detach() for w in weights)
        grad_F = torch.empty_like(F) if grad_F is None else grad_F
        if grad_weights is None:
            grad_weights = tuple(torch.zeros_like(w) for w in weights)
        if not len(F):
            return grad_F, grad_weights
        _, output_adjoint, input_adjoint = output_kernels(F.dtype, self.kind)
        W0, W1, W2 = weights
        state = _scratch.get(_Forward, F) if cache is None else cache
        if cache is None:
            self._network(F, weights, state)
        back = _scratch.get(_Backward, F)
        launch(output_adjoint, len(F), F, state.R, g, self.scale, back.grad_Y)
        grad_Y = back.grad_Y.view(-1, 9)
        grad_weights[2].addmm_(grad_Y.mT, state.h1)
        torch.mm(grad_Y, W2, out=back.grad_h)
        aten.gelu_backward.grad_input(back.grad_h, state.a1, grad_input=back.grad_a)
        grad_weights[1].addmm_(back.grad_a.mT, state.h0)
        torch.mm(back.grad_a, W1, out=back.grad_h)
        aten.gelu_backward.grad_input(back.grad_h, state.a0, grad_input=back.grad_a)
        grad_weights[0].add_((state.z.mT @ back.grad_a).mT)  # faster than the other order of factors
        torch.mm(back.grad_a, pad(W0, (0, PADDED - FEATURES)), out=back.grad_z)
        launch(
            input_adjoint, len(F), F, state.R, state.Vh, state.z, state.Y, g, back.grad_z[:, :FEATURES], self.scale,
            grad_F,
        )  # fmt: skip
        return grad_F, grad_weights


class NeuralElasticity(NeuralConstitutive, Elasticity):
    """P = R X, tau = P F^T [Pa]."""

    kind = "elasticity"
    scale = 1.0


class NeuralPlasticity(NeuralConstitutive, Plasticity):
    """F = F_trial + 1e-3 R X."""

    kind = "plasticity"
    scale = PLASTIC_SCALE


class NeuralLaw(AdaptableLaw):
    """Elasticity and plasticity as networks. Only the parameters of an attached adaptor are trainable."""

    elasticity: NeuralElasticity
    plasticity: NeuralPlasticity


def neural_law(state: dict[str, Tensor] | None = None, name: str = "neural", seed: int = 0) -> NeuralLaw:
    """Neural law from the tensors of :meth:`NeuralLaw.prior_state`, or Xavier-uniform from ``seed``.

    Raises:
        InputError: a tensor is missing or has another shape.
    """
    if state is None:
        return NeuralLaw(NeuralElasticity(seed=2 * seed), NeuralPlasticity(seed=2 * seed + 1), name)
    kinds = NeuralElasticity, NeuralPlasticity
    return NeuralLaw(*(kind(layers_of(state, kind.kind, f"prior {name}")) for kind in kinds), name)
