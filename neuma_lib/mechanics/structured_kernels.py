"""Kernels of `structured`, one forward and one backward for CPU and CUDA: SVD, invariants, network, principal values.

``structured_kernels.h`` processes packs of rows, one per SIMD lane, on a CPU, and one row per thread on a GPU. A row
stays in registers from F to the result. The backward kernel recomputes everything except the SVD, which a CPU caches,
and uses closed-form adjoints. Gradients of the weights are summed per pack on a CPU and per block on a GPU, where a
second kernel adds them in a fixed order.
"""

import math
from dataclasses import dataclass
from functools import cache
from types import SimpleNamespace

import torch
import warp as wp
from torch import Tensor

from neuma_lib.device import native_source
from neuma_lib.mechanics.elasticity import STRETCH_MIN
from neuma_lib.mechanics.fused_launch import addressed, block_count, contiguous, launch_blocks
from neuma_lib.mechanics.law import Weights
from neuma_lib.mechanics.singular_values_kernels import (
    CPU_WIDTH,
    END,
    FUSE,
    MATH,
    SVD,
    TYPES,
    filled,
    pack_count,
    warp_types,
)

WIDTH = 16
INVARIANTS = 3
LIMIT = 3.0  # bound of the outputs of the network, which scale a constant by at most exp(3) = 20
GROWTH = 2.0
"""Growth rate of constants that are zero in the base. After a first optimiser step the output is about 0.05: a share of
the trace then relaxes within some 4000 steps, and a cohesion or yield strain becomes 2e-5."""
STRAIN = 0.1  # unit of strain for the network
SMOOTH = 0.05  # strain below which the norm of the deviator, not differentiable at zero, is smoothed
LODE = 3 * math.sqrt(6)  # |det dev e| is at most |dev e|^3 / LODE
COHESION_UNIT = 0.02  # cohesion or yield strain at g = 1 if it is zero in the base; g is at most LIMIT
KINDS = {"stretch": 3, "energy": 2, "return": 5}
"""Number of network outputs by kind of kernel: the two forms of elasticity, and plasticity."""
BASES = ("hencky", "neo_hookean", "fixed_corotated")
"""Bases of elasticity in the order of their indices in the kernels."""
CACHED = 24  # numbers per row that a CPU caches: U, V, the singular values, and those after a return map
EVALUATE_WIDTH = {torch.float32: 32, torch.float64: 16}
"""Rows in a pack of the forward kernel on a CPU: two registers hide the latency of roots and quotients. The sums of the
backward kernel would not fit into the first cache."""
THREADS = {torch.float32: 128, torch.float64: 64}
"""Rows, and threads, per block. They use at most 40 KB of the 48 KB of shared memory that every GPU has."""
LANES, GROUPS = 32, 8  # of the kernel that adds the sums of blocks


@dataclass(frozen=True)
class Constants:
    """Index of the kind of law within its kernel, and its four constants."""

    kind: int
    values: tuple[float, float, float, float]


def weight_count(kind: str) -> int:
    return WIDTH * (INVARIANTS + 1) + (WIDTH + KINDS[kind]) * (WIDTH + 1)


def _constants(kind: str, dtype: torch.dtype) -> str:
    first = WIDTH * (INVARIANTS + 1)
    integers = {
        "INPUTS": INVARIANTS,
        "HIDDEN": WIDTH,
        "OUTPUTS": KINDS[kind],
        "W1_START": first,
        "W2_START": first + WIDTH * (WIDTH + 1),
        "WEIGHTS": weight_count(kind),
        "CACHED": CACHED,
        "CACHED_WIDTH": EVALUATE_WIDTH[dtype],
        "THREADS": THREADS[dtype],
        **{name.upper(): number for number, name in enumerate(BASES)},
        "GRANULAR": 1,
        "LANES": LANES,
        "GROUPS": GROUPS,
    }
    reals = {
        "STRETCH_MIN": STRETCH_MIN,
        "SMOOTH": SMOOTH,
        "LODE": LODE,
        "STRAIN": STRAIN,
        "LIMIT": LIMIT,
        "COHESION_UNIT": COHESION_UNIT,
        "GROWTH": GROWTH,
        "RISE": LIMIT / math.expm1(GROWTH * LIMIT),
    }
    text = "".join(f"    const int {name} = {value};\n" for name, value in integers.items())
    return text + "".join(f"    const Real {name} = Real({value!r});\n" for name, value in reals.items())


def source(kind: str, backward: bool, dtype: torch.dtype) -> str:
    """C++ source of the body of a kernel, one of :data:`KINDS`."""
    parts = native_source(__file__, ".h")
    if kind == "return":
        names = "const Real threshold_base = p0, friction_base = p1, rate_base = p2, associated = p3;"
        gradient, value, result = ("load_gradient",), ("plastic",), ("deformation",)
        adjoint = ("if_moves", "plastic_vjp", "network_vjp", "put_gradient", "end_if")
    else:
        names = "const Real mu = p0, lam = p1;"
        gradient, result = ("load_gradient", "stress_gradient"), ("stress",)
        value = ("stretch",) if kind == "stretch" else ("energy_parts", "energy")
        adjoint = (f"{kind}_vjp", "network_vjp", "stress_vjp", "put_gradient")
    if backward:
        body = ("sums", "rows", "decompose", "network", "pairs", *gradient, *value, *adjoint)
        body = (*body, "store_gradient", "end_rows", "put_sums")
    else:
        body = ("rows", "decompose", "network", "pairs", "no_gradient", *value, *result, "end_rows")
    text = FUSE + TYPES + _constants(kind, dtype) + MATH + f"    {names}\n" + parts["functions"]
    text += "".join(parts[name] for name in body) + parts["end"] + END
    energy = kind == "energy"
    for name, inserted in {
        "{SVD}": SVD,
        "{PLUS_B0}": " + b0[k]" if energy else "",
        "{PLUS_B1}": " + b1[k]" if energy else "",
        "{CHOOSE}": "g[k] = changed ? value : g[k];" if kind == "return" else "g[k] = value;",
    }.items():
        text = text.replace(name, inserted)
    return filled(text, dtype, CPU_WIDTH[dtype] if backward else EVALUATE_WIDTH[dtype])


def add_source(kind: str, dtype: torch.dtype) -> str:
    """C++ source of the body of the kernel that adds the sums of blocks."""
    return filled(TYPES + _constants(kind, dtype) + native_source(__file__, ".h")["add"] + END, dtype)


def _own(dtype: torch.dtype) -> SimpleNamespace:
    """Decorators of kernels, see `addressed`."""
    integers = dict.fromkeys(("kind", "n", "cached", "adds"), int)
    return addressed(**integers, **dict.fromkeys(("p0", "p1", "p2", "p3"), warp_types(dtype)[0]))


@cache
def evaluate_kernel(kind: str, dtype: torch.dtype):
    """Kernel (F, W0, W1, W2, index of the base, four constants, n, cached, cache, out), launched by `launch_blocks`.

    If ``cached`` is 1, it writes the SVD to the cache (packs, CACHED, EVALUATE_WIDTH). If it is 3, F is the result of
    the return map that has written the cache.
    """
    own = _own(dtype)

    @own.func_native(source(kind, False, dtype))
    def evaluate_rows(F, W0, W1, W2, kind, p0, p1, p2, p3, n, cached, cache, out): ...

    @own.kernel("unique", grid_stride=False)
    def structured_evaluate(F, W0, W1, W2, kind, p0, p1, p2, p3, n, cached, cache, out):
        evaluate_rows(F, W0, W1, W2, kind, p0, p1, p2, p3, n, cached, cache, out)

    return structured_evaluate


@cache
def vjp_kernel(kind: str, dtype: torch.dtype):
    """Kernel (F, W0, W1, W2, index of the base, four constants, n, cached, cache, adds, grad_out, grad_F, ...).

    If ``cached`` is 2 or 3, it reads the SVD from the cache. If ``adds`` is 1, it adds to grad_F. It adds the gradients
    of the weights to three totals on a CPU, and writes them to partials (blocks, weights) on a GPU.
    """
    own = _own(dtype)

    @own.func_native(source(kind, True, dtype))
    def vjp_rows(
        F, W0, W1, W2, kind, p0, p1, p2, p3, n, cached, cache, adds, grad_out, grad_F, total0, total1, total2,
        partials,
    ): ...  # fmt: skip

    @own.kernel("unique", grid_stride=False)
    def structured_vjp(
        F, W0, W1, W2, kind, p0, p1, p2, p3, n, cached, cache, adds, grad_out, grad_F, total0, total1, total2,
        partials,
    ):  # fmt: skip
        vjp_rows(
            F, W0, W1, W2, kind, p0, p1, p2, p3, n, cached, cache, adds, grad_out, grad_F,
            total0, total1, total2, partials,
        )  # fmt: skip

    return structured_vjp


@cache
def add_kernel(kind: str, dtype: torch.dtype):
    """CUDA kernel (partials (blocks, weights), their number, three totals) that adds the sums of blocks."""

    own = addressed(summands=int)

    @own.func_native(add_source(kind, dtype))
    def add_columns(partials, summands, total0, total1, total2): ...

    @own.kernel("unique", grid_stride=False)
    def structured_add(partials, summands, total0, total1, total2):
        add_columns(partials, summands, total0, total1, total2)

    return structured_add


def _blocks(F: Tensor) -> int:
    """Thread blocks for the rows of F. On a CPU one thread processes all rows."""
    return 1 if F.device.type == "cpu" else block_count(len(F), THREADS[F.dtype], F.device)


def kernel_of(
    kind: str, constants: Constants, F: Tensor, weights: Weights, backward: bool
) -> tuple[wp.Kernel, dict[str, Tensor | float]]:
    """Kernel and arguments of `Constitutive.kernel`."""
    values = {f"W{i}": w.detach().contiguous() for i, w in enumerate(weights)}
    values |= {"kind": constants.kind, "n": len(F)} | {f"p{i}": p for i, p in enumerate(constants.values)}
    return vjp_kernel(kind, F.dtype) if backward else evaluate_kernel(kind, F.dtype), values


def cache_shape(F: Tensor) -> tuple[int, int, int]:
    """Shape (packs, CACHED, EVALUATE_WIDTH) of memory for the SVD of F (n, 3, 3) on a CPU."""
    return pack_count(len(F), F.device, EVALUATE_WIDTH[F.dtype]), CACHED, EVALUATE_WIDTH[F.dtype]


def new_cache(F: Tensor) -> Tensor | None:
    """Memory for the SVD of F (n, 3, 3) on a CPU, None on a GPU."""
    return F.new_empty(cache_shape(F)) if F.device.type == "cpu" else None


@torch.no_grad()
def evaluate(
    kind: str,
    constants: Constants,
    F: Tensor,
    weights: Weights,
    out: Tensor | None = None,
    cache: Tensor | None = None,
) -> Tensor:
    """Evaluate the law of ``kind`` at F (n, 3, 3) and store the SVD in ``cache`` if given. See `Constitutive`."""
    F = F.detach().contiguous()
    out = torch.empty_like(F) if out is None else out
    with contiguous(out) as (result,):
        if len(F):
            W = [w.detach().contiguous() for w in weights]
            inputs = *W, constants.kind, *constants.values, len(F), int(cache is not None), cache, result
            launch_blocks(evaluate_kernel(kind, F.dtype), _blocks(F), THREADS[F.dtype], F, *inputs)
    return out


@torch.no_grad()
def vjp(
    kind: str,
    constants: Constants,
    F: Tensor,
    weights: Weights,
    grad_out: Tensor,
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
            W, blocks = [w.detach().contiguous() for w in weights], _blocks(F)
            partials = None if F.device.type == "cpu" else F.new_empty(blocks, weight_count(kind))
            cached = 0 if cache is None else 2
            inputs = *W, constants.kind, *constants.values, len(F), cached, cache, 0, grad_out, result
            launch_blocks(vjp_kernel(kind, F.dtype), blocks, THREADS[F.dtype], F, *inputs, *sums, partials)
            if partials is not None:
                columns = -(-weight_count(kind) // LANES)
                launch_blocks(add_kernel(kind, F.dtype), columns, LANES * GROUPS, partials, blocks, *sums)
    return grad_F, totals
