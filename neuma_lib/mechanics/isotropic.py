"""Isotropic tensor functions through singular values, and the constants of analytic laws.

With F = U diag(sigma) V^T, an isotropic law is given by three principal values y(sigma), as a stress U diag(y) U^T or
as a deformation U diag(y) V^T. The adjoints need divided differences of y, which are finite at equal singular values.
:func:`_separate` evaluates them without a branch by keeping both values at least eps^(1/3) apart (error eps^(2/3),
because the quotient is an even function of the distance). Laws with closed-form divided differences use
:func:`coaxial_stress` and :func:`coaxial_deformation`.
"""

from collections.abc import Callable

import torch
from torch import Tensor, nn

from neuma_lib.mechanics import analytic_kernels as kernels
from neuma_lib.mechanics.catalogue import Constant, check_constants
from neuma_lib.mechanics.singular_values import away_from_zero, rotation_and_singular_values, svd3

PrincipalFunction = Callable[[Tensor], Tensor]
"""Singular values (N, 3) -> principal values (N, 3), equivariant under permutations."""

Quotients = Callable[[Tensor], tuple[Tensor, Tensor, Tensor]]
"""Singular values (N, 3) -> for each pair of :data:`PAIRS` the divided difference (y_i - y_j) / (sigma_i - sigma_j),
y_i + y_j and sigma_i + sigma_j, (N, 3 pairs) each."""

PAIRS = ((0, 1), (0, 2), (1, 2))


def _separate(sigma: Tensor, function: PrincipalFunction) -> tuple[Tensor, Tensor]:
    """For each pair (i, j) of :data:`PAIRS`: sigma_i and sigma_j, separated about their mean, and y_i, y_j there;
    both (N, 3 pairs, 2)."""
    least = torch.finfo(sigma.dtype).eps ** (1 / 3)
    moved = sigma[:, None].repeat(1, 3, 1)
    for pair, (i, j) in enumerate(PAIRS):
        mean = 0.5 * (sigma[:, i] + sigma[:, j])
        half = 0.5 * (sigma[:, i] - sigma[:, j]).clamp(min=least)
        moved[:, pair, i] = mean + half
        moved[:, pair, j] = mean - half
    y = function(moved.reshape(-1, 3)).reshape(-1, 3, 3)
    index = torch.tensor(PAIRS, device=sigma.device).expand(len(sigma), 3, 2)
    return moved.gather(2, index), y.gather(2, index)


def _symmetric(pairs: Tensor) -> Tensor:
    """(N, 3 pairs) -> symmetric (N, 3, 3) with zero diagonal."""
    zero = torch.zeros_like(pairs[:, 0])
    a, b, c = pairs.unbind(1)
    return torch.stack([zero, a, b, a, zero, c, b, c, zero], dim=1).reshape(-1, 3, 3)


def _numeric_quotients(function: PrincipalFunction) -> Quotients:
    """Divided differences of a function from its values."""

    def quotients(sigma):
        s, y = _separate(sigma, function)
        return (y[..., 0] - y[..., 1]) / (s[..., 0] - s[..., 1]), y.sum(-1), s.sum(-1)

    return quotients


def _decompose(ctx, F: Tensor, quotients: Quotients) -> tuple[Tensor, Tensor, Tensor]:
    """U, sigma, Vh of F, saved for backward together with the quotients."""
    parts = svd3(F)
    ctx.quotients = quotients
    ctx.save_for_backward(*parts)
    return parts


def _stress(U: Tensor, y: Tensor) -> Tensor:
    return (U * y[:, None]) @ U.mT


def _deformation(F: Tensor, U: Tensor, sigma: Tensor, Vh: Tensor, y: Tensor) -> Tensor:
    unchanged = (y == sigma).all(dim=1)
    return torch.where(unchanged[:, None, None], F, (U * y[:, None]) @ Vh)


class _Stress(torch.autograd.Function):
    """(F, y) -> U diag(y) U^T. The gradient with respect to F is that of U at fixed y."""

    @staticmethod
    def forward(ctx, F, y, quotients):
        U, _, _ = _decompose(ctx, F, quotients)
        return _stress(U, y)

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx, grad):
        U, sigma, Vh = ctx.saved_tensors
        G = U.mT @ grad @ U
        quotient, _, total = ctx.quotients(sigma)
        quotient = quotient / away_from_zero(total, torch.finfo(sigma.dtype).eps)
        K = _symmetric(quotient) * (G + G.mT) * sigma[:, None]
        return U @ K @ Vh, G.diagonal(dim1=1, dim2=2), None


class _Deformation(torch.autograd.Function):
    """(F, y) -> U diag(y) V^T, exactly F where y equals sigma. The gradient with respect to F is that of U and V at
    fixed y."""

    @staticmethod
    def forward(ctx, F, y, quotients):
        return _deformation(F, *_decompose(ctx, F, quotients), y)

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx, grad):
        U, sigma, Vh = ctx.saved_tensors
        G = U.mT @ grad @ Vh.mT
        quotient, y_total, total = ctx.quotients(sigma)
        stretch = _symmetric(quotient)
        rotation = _symmetric(y_total / away_from_zero(total, torch.finfo(sigma.dtype).eps))
        K = 0.5 * stretch * (G + G.mT) + 0.5 * rotation * (G - G.mT)
        return U @ K @ Vh, G.diagonal(dim1=1, dim2=2), None


def coaxial_stress(F: Tensor, y: Tensor, quotients: Quotients) -> Tensor:
    """U diag(y) U^T, (N, 3, 3), for principal values y (N, 3) of F, differentiable in F and y."""
    return _Stress.apply(F, y, quotients)


def coaxial_deformation(F: Tensor, y: Tensor, quotients: Quotients) -> Tensor:
    """U diag(y) V^T, (N, 3, 3), differentiable in F and y; exactly F where y equals the singular values."""
    return _Deformation.apply(F, y, quotients)


def isotropic_stress(F: Tensor, function: PrincipalFunction) -> Tensor:
    """U diag(y(sigma)) U^T, (N, 3, 3), differentiable in F and in the tensors that ``function`` closes over."""
    if not torch.is_grad_enabled():  # one decomposition instead of two
        U, sigma, _ = svd3(F)
        return _stress(U, function(sigma))
    _, sigma = rotation_and_singular_values(F) if F.requires_grad else (None, svd3(F)[1])
    return coaxial_stress(F, function(sigma), _numeric_quotients(function))


def isotropic_deformation(F: Tensor, function: PrincipalFunction) -> Tensor:
    """U diag(y(sigma)) V^T, (N, 3, 3), differentiable like `isotropic_stress`; exactly F where y(sigma) = sigma."""
    if not torch.is_grad_enabled():
        parts = svd3(F)
        return _deformation(F, *parts, function(parts[1]))
    _, sigma = rotation_and_singular_values(F) if F.requires_grad else (None, svd3(F)[1])
    return coaxial_deformation(F, function(sigma), _numeric_quotients(function))


class Constants(nn.Module):
    """Mix-in of an `Elasticity` or `Plasticity` that checks and holds the constants of a law.

    A number is fixed. A tensor that requires a gradient becomes one of the law's ``weights()``, in the order of
    ``constants``, so that an analytic law can be fitted like a neural one.

    The built-in laws state their ``coefficients``, a static function of the constants as tensors, and are evaluated by
    :mod:`analytic_kernels`. Other laws, which may derive from these, are evaluated by `response`.
    """

    constants: dict[str, Constant] = {}
    part: str

    @property
    def kernel_name(self) -> str:
        """Name of the law in `analytic_kernels.LAWS`."""
        return type(self).__name__

    def __init__(self, **values: float | Tensor):
        super().__init__()
        plain = {key: value.detach() if isinstance(value, Tensor) else value for key, value in values.items()}
        numbers = check_constants(type(self).__name__, self.constants, plain)
        self.values: dict[str, float | Tensor] = {
            name: values[name] if isinstance(values.get(name), Tensor) else number
            for name, number in numbers.items()
        }

    def _fitted(self) -> list[str]:
        return [n for n, v in self.values.items() if isinstance(v, Tensor) and v.requires_grad]

    def weights(self) -> tuple[Tensor, ...]:
        return tuple(self.values[name] for name in self._fitted())

    def with_weights(self, weights: tuple[Tensor, ...]) -> dict[str, float | Tensor]:
        """All constants, with the given weights in place of the fitted ones."""
        return {**self.values, **dict(zip(self._fitted(), weights, strict=True))}

    @property
    def native(self) -> bool:
        """Whether the law has a kernel."""
        return "coefficients" in vars(type(self))

    @property
    def capturable(self) -> bool:
        """Whether `evaluate` and `vjp` can be recorded in a CUDA graph. The constants are then part of it."""
        return self.native and not self._fitted()

    def row(self, weights: tuple[Tensor, ...] = ()) -> Tensor:
        """Row of the kernels (1 + COEFFICIENTS,) in float64, differentiable in the constants. ``weights`` replace the
        fitted ones if given."""
        values = self.with_weights(weights) if weights else self.values
        device = next((w.device for w in weights), None)
        tensors = {
            key: torch.as_tensor(x, dtype=torch.float64, device=device).reshape(())
            for key, x in values.items()
        }
        return kernels.row(self.kernel_name, self.coefficients(**tensors))

    @property
    def native_rows(self) -> bool:
        return self.native

    @property
    def keeps_singular_values(self) -> bool:
        return self.native and self.kernel_name not in kernels.WITHOUT_SINGULAR_VALUES

    @property
    def loops(self) -> bool:
        return self.native

    def kernel_rows(self, F: Tensor, weights: tuple[Tensor, ...]) -> Tensor:
        return self._rows(F, weights)

    def kernel(self, F, weights, backward):
        return kernels.kernel_of(self.part, F, self._rows(F, weights), backward)

    def cache_shape(self, F, weights):
        return kernels.cache_shape(1, len(F), F)

    def _rows(self, F: Tensor, weights: tuple[Tensor, ...]) -> Tensor:
        """Rows (1, 1 + COEFFICIENTS) for F, kept while neither the weights nor the dtype and device change."""
        state = F.dtype, F.device, [w._version for w in weights]
        kept = self.__dict__.get("_kept")
        if kept is None or kept[0] != state or not _same(kept[1], weights):
            with torch.no_grad():
                rows = self.row(weights)[None].to(F.device, F.dtype)
            self.__dict__["_kept"] = kept = state, weights, rows
        return kept[2]

    def evaluate(self, F: Tensor, weights: tuple[Tensor, ...], out: Tensor | None = None) -> Tensor:
        if not self.native:
            return super().evaluate(F, weights, out)
        return kernels.evaluate(self.part, F, self._rows(F, weights), out)

    def evaluate_with_cache(self, F, weights, out=None, cache=None):
        if not self.keeps_singular_values:
            return self.evaluate(F, weights, out), None
        cache = kernels.new_cache(F, 1) if cache is None else cache
        return kernels.evaluate(self.part, F, self._rows(F, weights), out, cache), cache

    def vjp(self, F, weights, grad_out, cache=None, grad_F=None, grad_weights=None):
        if not self.native:
            return super().vjp(F, weights, grad_out, cache, grad_F, grad_weights)
        if grad_weights is None:
            grad_weights = tuple(torch.zeros_like(w) for w in weights)
        sums = grad_weights if _are_rows(grad_weights) else self.accumulators(F, grad_weights)
        grad_rows = sums[0] if weights else None
        grad_F = kernels.vjp(self.part, F, self._rows(F, weights), grad_out, cache, grad_F, grad_rows)
        if sums is not grad_weights:
            self.add_up(sums, weights, grad_weights)
        return grad_F, grad_weights

    def accumulators(self, F, grad_weights):
        if not self.native or not grad_weights:
            return grad_weights
        return (torch.zeros(1, 1 + kernels.COEFFICIENTS, dtype=torch.float64, device=F.device),)

    def add_up(self, accumulators, weights, grad_weights):
        if not _are_rows(accumulators):
            return
        with torch.enable_grad():
            leaves = [w.detach().requires_grad_() for w in weights]
            grads = torch.autograd.grad(self.row(tuple(leaves)), leaves, accumulators[0][0])
        for total, grad in zip(grad_weights, grads, strict=True):
            total.add_(grad)


def _are_rows(accumulators: tuple[Tensor, ...]) -> bool:
    """Whether these are gradients of rows instead of constants."""
    return len(accumulators) == 1 and accumulators[0].ndim == 2


def _same(one: tuple[Tensor, ...], other: tuple[Tensor, ...]) -> bool:
    return len(one) == len(other) and all(a is b for a, b in zip(one, other, strict=True))
