"""Neural constitutive laws (NCLaw, Ma et al. 2023): the paper's M_0, optionally with an adaptor Delta M.

A network of three layers without bias, 13 -> 64 -> 64 -> 9 with GELU activations, maps the rotation-invariant features
(sigma - 1, F^T F - I, det F - 1) to an output whose symmetric part X gives

- elasticity: P = R X, tau = P F^T;
- plasticity: F = F_trial + 1e-3 R X.

Zero features give zero output because there is no bias, so rotations are stress-free. R makes both maps objective.

:mod:`neural_vector` has kernels for a CPU and :mod:`neural_fused` for float32 on GPUs with float16 tensor cores. On
other GPUs, and in float64 on any, autograd differentiates `NeuralConstitutive.response`, the reference of the kernels.
"""

from collections.abc import Hashable
from types import ModuleType

import torch
from torch import Tensor
from torch.nn.functional import gelu

from neuma_lib.errors import InputError
from neuma_lib.mechanics import neural_fused, neural_vector
from neuma_lib.mechanics.adaptor import AdaptableConstitutive, AdaptableLaw, layers_of
from neuma_lib.mechanics.law import Elasticity, Plasticity, Weights
from neuma_lib.mechanics.neural_vector import FEATURES
from neuma_lib.mechanics.singular_values import rotation_and_singular_values

WIDTH = 64
SHAPES = ((WIDTH, FEATURES), (WIDTH, WIDTH), (9, WIDTH))
PLASTIC_SCALE = 1e-3


def features(F: Tensor, sigma: Tensor) -> Tensor:
    """(N, 13) features of F (N, 3, 3) with singular values sigma (N, 3); differentiable torch."""
    eye = torch.eye(3, dtype=F.dtype, device=F.device)
    gram = (F.mT @ F - eye).reshape(-1, 9)
    return torch.cat([sigma - 1, gram, torch.linalg.det(F)[:, None] - 1], dim=1)


class NeuralConstitutive(AdaptableConstitutive):
    """A network with frozen base weights and an optional adaptor: M = M_0 + Delta M (paper Eq. 3)."""

    kind: str
    scale: float
    native = True
    keeps_singular_values = True
    loops = True

    @property
    def capturable(self) -> bool:
        return neural_fused.supported(self.base[0].device, self.base[0].dtype)

    def graph_key(self) -> Hashable:
        return type(self), self.adjoint_precision

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

    def evaluate(self, F: Tensor, weights: Weights, out: Tensor | None = None) -> Tensor:
        kernels = _kernels(F)
        if kernels is None:
            return super().evaluate(F, weights, out)
        return kernels.evaluate(F, weights, self.kind, self.scale, out)

    def evaluate_with_cache(self, F, weights, out=None, cache=None):
        if F.device.type != "cpu":
            return self.evaluate(F, weights, out), None
        cache = F.new_empty(self.cache_shape(F, weights)) if cache is None else cache
        return neural_vector.evaluate(F, weights, self.kind, self.scale, out, cache), cache

    def kernel(self, F, weights, backward):
        return neural_vector.kernel_of(self.kind, self.scale, F, weights, backward)

    def cache_shape(self, F, weights):
        return neural_vector.cache_shape(F)

    def accumulators(self, F, grad_weights):
        return (neural_fused.partial_sums(F),) if _kernels(F) is neural_fused else grad_weights

    @torch.no_grad()
    def add_up(self, accumulators, weights, grad_weights):
        if len(accumulators) != len(grad_weights):
            neural_fused.add_up(*accumulators, grad_weights)

    def vjp(self, F, weights, grad_out, cache=None, grad_F=None, grad_weights=None):
        kernels = _kernels(F)
        if kernels is None:
            return super().vjp(F, weights, grad_out, cache, grad_F, grad_weights)
        if kernels is neural_vector:
            grads = (cache, grad_F, grad_weights)
        else:
            grads = (grad_F, grad_weights, self.adjoint_precision)
        return kernels.vjp(F, weights, grad_out, self.kind, self.scale, *grads)


def _kernels(F: Tensor) -> ModuleType | None:
    """The module with kernels for the device and dtype of F, if there is one."""
    if F.device.type == "cpu":
        return neural_vector
    return neural_fused if neural_fused.supported(F.device, F.dtype) else None


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
