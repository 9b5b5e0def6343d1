"""Neural constitutive law as one kernel forward and one backward on a CPU: features, network, stress.

``neural_vector.h`` processes blocks of rows that stay in the cache of a core. Tiles of the matrix products stay in
registers. The symmetric matrices F^T F and X have six elements, so that the layers are 10 -> 64 -> 64 -> 6. GELU uses
polynomials for the standard normal distribution and its density. The backward kernel recomputes the network.
"""

import math
from collections.abc import Callable
from fractions import Fraction
from functools import cache

import torch
import warp as wp
from torch import Tensor

from neuma_lib.device import native_source
from neuma_lib.mechanics.analytic_kernels import CPU_WIDTH
from neuma_lib.mechanics.fused_launch import addressed, contiguous, launch_blocks
from neuma_lib.mechanics.law import Weights
from neuma_lib.mechanics.singular_values_kernels import END, FUSE, SVD, TYPES, filled, warp_types

FEATURES = 13
GRAM = native_source(__file__, ".h")["gram"]  # C++ source of F^T F and det F
BLOCK = 64  # rows per block
HIDDEN = 64
INPUTS, OUTPUTS = 10, 6
"""Columns of the first and rows of the last layer, with one for each pair of equal features or outputs."""
KEPT = 27
"""Numbers per row in a cache: U, V, the singular values and X. Activations are recomputed, which is faster."""
NARROW = 16  # columns of a matrix of inputs or outputs: those of a vector, the last ones unused
RANGE = {torch.float32: 5.75, torch.float64: 8.3}
"""|x| from which the standard normal distribution is constant to round-off."""
TERMS = {torch.float32: (16, 6), torch.float64: (36, 12)}
"""Coefficients of the polynomials for the distribution and the density, for an error of round-off."""


def chebyshev(function: Callable[[float], float], low: float, high: float, terms: int) -> list[float]:
    """Coefficients, highest power first, of the polynomial in t that interpolates f at the Chebyshev nodes of
    [low, high], which t in [-1, 1] spans."""
    angles = [math.pi * (k + 0.5) / terms for k in range(terms)]
    values = [function(0.5 * (low + high) + 0.5 * (high - low) * math.cos(angle)) for angle in angles]
    total = [Fraction(0)] * terms
    older, old = [Fraction(1)], [Fraction(0), Fraction(1)]  # T_0, T_1 in exact arithmetic
    for n in range(terms):
        mean = math.fsum(v * math.cos(n * angle) for v, angle in zip(values, angles, strict=True)) / terms
        for k, c in enumerate(older):
            total[k] += Fraction(mean if n == 0 else 2 * mean) * c
        new = [Fraction(0), *(2 * c for c in old)]
        for k, c in enumerate(older):
            new[k] -= c
        older, old = old, new
    return [float(c) for c in reversed(total)]


@cache
def gelu_polynomials(dtype: torch.dtype) -> tuple[list[float], list[float]]:
    """Polynomials for GELU, with the standard normal distribution Phi: in t = 2 (x / RANGE)^2 - 1 for
    (Phi(x) - 1/2) / x, and in r, |r| <= 1/2, for 2^r / sqrt(2 pi)."""
    terms = TERMS[dtype]
    distribution = chebyshev(
        lambda u: math.erf(math.sqrt(0.5 * u)) / (2 * math.sqrt(u)), 0.0, RANGE[dtype] ** 2, terms[0]
    )
    density = chebyshev(lambda r: 2**r / math.sqrt(2 * math.pi), -0.5, 0.5, terms[1])
    powers = range(terms[1] - 1, -1, -1)
    return distribution, [c * 2**power for c, power in zip(density, powers, strict=True)]


def source(backward: bool, dtype: torch.dtype) -> str:
    """C++ source of the body of a kernel. ``elastic`` is 1 for elasticity and 0 for plasticity."""
    parts = native_source(__file__, ".h")
    integers = {"BLOCK": BLOCK, "HIDDEN": HIDDEN, "NARROW": NARROW, "FEATURES": FEATURES}
    integers |= {"INPUTS": INPUTS, "OUTPUTS": OUTPUTS, "KEPT": KEPT}
    text = "".join(f"    const int {name} = {value};\n" for name, value in integers.items())
    text += (
        f"    const Real FLOOR = Real({torch.finfo(dtype).eps ** 0.5!r}), RANGE = Real({RANGE[dtype]!r});\n"
    )
    for name, values in zip(("DISTRIBUTION", "DENSITY"), gelu_polynomials(dtype), strict=True):
        numbers = ", ".join(f"Real({value!r})" for value in values)
        text += f"    const Real {name}[{len(values)}] = {{{numbers}}};\n"
    tools = parts["tools"].replace("{GRAM}", GRAM).replace("{SVD}", SVD)
    body = parts["vjp" if backward else "evaluate"] + parts["end"]
    return filled(FUSE + TYPES + text + tools + body + END, dtype, CPU_WIDTH[dtype])


@cache
def evaluate_kernel(dtype: torch.dtype):
    """Kernel (F, W0, W1, W2, elastic, scale, n, cached, cache, out), launched by `launch_blocks`.

    If ``cached`` is 1, it fills the cache.
    """
    own = addressed(elastic=int, scale=warp_types(dtype)[0], n=int, cached=int)

    @own.func_native(source(False, dtype))
    def evaluate_rows(F, W0, W1, W2, elastic, scale, n, cached, cache, out): ...

    @own.kernel("unique", grid_stride=False)
    def neural_vector_evaluate(F, W0, W1, W2, elastic, scale, n, cached, cache, out):
        evaluate_rows(F, W0, W1, W2, elastic, scale, n, cached, cache, out)

    return neural_vector_evaluate


@cache
def vjp_kernel(dtype: torch.dtype):
    """Kernel (F, W0, W1, W2, elastic, scale, n, cached, cache, adds, grad_out, grad_F, total0, total1, total2).

    If ``cached`` is 2, it reads the cache. If ``adds`` is 1, it adds to grad_F. It adds the gradients of the weights to
    the totals.
    """
    own = addressed(elastic=int, scale=warp_types(dtype)[0], n=int, cached=int, adds=int)

    @own.func_native(source(True, dtype))
    def vjp_rows(
        F, W0, W1, W2, elastic, scale, n, cached, cache, adds, grad_out, grad_F, total0, total1, total2
    ): ...

    @own.kernel("unique", grid_stride=False)
    def neural_vector_vjp(
        F, W0, W1, W2, elastic, scale, n, cached, cache, adds, grad_out, grad_F, total0, total1, total2
    ):
        vjp_rows(
            F, W0, W1, W2, elastic, scale, n, cached, cache, adds, grad_out, grad_F, total0, total1, total2
        )  # fmt: skip

    return neural_vector_vjp


def kernel_of(
    kind: str, scale: float, F: Tensor, weights: Weights, backward: bool
) -> tuple[wp.Kernel, dict[str, Tensor | float]]:
    """Kernel and arguments of `Constitutive.kernel`."""
    values = {f"W{i}": w.detach().contiguous() for i, w in enumerate(weights)}
    values |= {"elastic": int(kind == "elasticity"), "scale": scale, "n": len(F)}
    return (vjp_kernel if backward else evaluate_kernel)(F.dtype), values


def cache_shape(F: Tensor) -> tuple[int, int]:
    """Shape (blocks, KEPT BLOCK) of memory for the SVD and the outputs of F (n, 3, 3)."""
    return -(-len(F) // BLOCK), KEPT * BLOCK


@torch.no_grad()
def evaluate(
    F: Tensor,
    weights: Weights,
    kind: str,
    scale: float,
    out: Tensor | None = None,
    cache: Tensor | None = None,
) -> Tensor:
    """Evaluate the law of ``kind`` at F (n, 3, 3), plasticity as F + scale R X. Fills ``cache`` if given.

    See `Constitutive`.
    """
    F = F.detach().contiguous()
    out = torch.empty_like(F) if out is None else out
    with contiguous(out) as (result,):
        if len(F):
            kernel, values = kernel_of(kind, scale, F, weights, False)
            launch_blocks(kernel, 1, 1, F, *values.values(), int(cache is not None), cache, result)
    return out


@torch.no_grad()
def vjp(
    F: Tensor,
    weights: Weights,
    grad_out: Tensor,
    kind: str,
    scale: float,
    cache: Tensor | None = None,
    grad_F: Tensor | None = None,
    grad_weights: Weights | None = None,
) -> tuple[Tensor, Weights]:
    """Gradients of F and, added to ``grad_weights``, of the weights. See `Constitutive`."""
    F, grad_out = F.detach().contiguous(), grad_out.contiguous()
    grad_F = torch.empty_like(F) if grad_F is None else grad_F
    totals = tuple(torch.zeros_like(w) for w in weights) if grad_weights is None else grad_weights
    with contiguous(grad_F, *totals) as (result, *sums):
        if len(F):
            kernel, values = kernel_of(kind, scale, F, weights, True)
            cached = 0 if cache is None else 2
            launch_blocks(kernel, 1, 1, F, *values.values(), cached, cache, 0, grad_out, result, *sums)
    return grad_F, totals
