"""Kernels of the built-in analytic laws, one forward and one backward for CPU and CUDA, float32 and float64.

``analytic_kernels.h`` states each law once, for packs: one row per SIMD lane on a CPU, one per thread on a GPU. The
adjoints are closed forms in principal axes. All laws of a kind share a kernel. The law and its constants are a row of
numbers, so that simulations of several laws can share a launch, and a recorded CUDA graph applies to any constants.
"""

from functools import cache
from typing import Literal

import torch
import warp as wp
from torch import Tensor

from neuma_lib.device import native_source, start_warp
from neuma_lib.mechanics.fused_launch import addressed, launch_blocks
from neuma_lib.mechanics.singular_values_kernels import END, FUSE, MATH, SVD, TYPES, filled, pack_count

start_warp()

Kind = Literal["elasticity", "plasticity"]

STRETCH_MIN = 0.05
"""Logarithms are of max(sigma, STRETCH_MIN), as in NCLaw, which bounds the stress of a crushed element."""
FIBRE_EXPONENT_MAX = 8.0
"""Bound on the exponent of the fibre term, which limits its stiffness to e^8 = 3,000 times that at rest."""

LAWS = (
    "FixedCorotated",
    "StVK",
    "Hencky",
    "NeoHookean",
    "Fluid",
    "Tait",
    "Ogden",
    "MooneyRivlin",
    "FibreReinforced",
    "Identity",
    "VonMises",
    "DruckerPrager",
    "FluidProjection",
    "ViscousFlow",
    "CrushableFoam",
    "HerschelBulkley",
    "CohesiveDruckerPrager",
)
"""Names of the classes of laws with kernels, in the order of their indices."""
WITHOUT_SINGULAR_VALUES = {"StVK", "NeoHookean", "Fluid", "Identity"}
COEFFICIENTS = 7  # largest number of coefficients of a law
KEPT = 21  # numbers per row in a cache: U, V and the singular values
CPU_WIDTH = {torch.float32: 32, torch.float64: 16}
"""Rows in a pack on a CPU: 1024 bits, so that two or more registers hide the latency of roots and quotients."""
THREADS = 64  # threads per block on a GPU
_own = addressed(copies=int, n=int)


def row(law: str, coefficients: tuple[Tensor | float, ...]) -> Tensor:
    """Row (1 + COEFFICIENTS,) of a law in float64: its index in `LAWS` and its coefficients, padded with zeros."""
    like = next((x for x in coefficients if isinstance(x, Tensor)), torch.zeros(()))
    numbers = [LAWS.index(law), *coefficients, *(0.0 for _ in range(COEFFICIENTS - len(coefficients)))]
    return torch.stack([torch.as_tensor(x, dtype=torch.float64, device=like.device) for x in numbers])


def laws(dtype: torch.dtype, width: int | None = None) -> str:
    """C++ source that defines `stress`, `return_map`, `flow` and their adjoints, see ``analytic_kernels.h``.

    ``width`` is the number of particles in a pack on a CPU, by default `CPU_WIDTH`."""
    parts = native_source(__file__, ".h")
    constants = (
        f"    enum {{ {', '.join(LAWS)} }};\n    const int COEFFICIENTS = {COEFFICIENTS}, KEPT = {KEPT};\n"
    )
    for name, value in (("STRETCH_MIN", STRETCH_MIN), ("FIBRE_EXPONENT_MAX", FIBRE_EXPONENT_MAX)):
        constants += f"    const Real {name} = Real({value!r});\n"
    text = FUSE + TYPES + constants + MATH
    text += "".join(parts[name] for name in ("functions", "elasticity", "plasticity", "flow"))
    return filled(text.replace("{SVD}", SVD), dtype, width or CPU_WIDTH[dtype])


def source(kind: Kind | Literal["flow"], backward: bool, dtype: torch.dtype) -> str:
    """C++ source of the body of a kernel."""
    parts, suffix = native_source(__file__, ".h"), "_flow" if kind == "flow" else ""
    text = parts["rows"] + parts[("vjp" if backward else "evaluate") + suffix] + END
    text = f"    const int THREADS = {THREADS};\n" + text
    forward, vjp = ("stress", "stress_vjp") if kind == "elasticity" else ("return_map", "return_vjp")
    return laws(dtype) + text.replace("FORWARD", forward).replace("VJP", vjp)


@cache
def evaluate_kernel(kind: Kind, dtype: torch.dtype):
    """Kernel (F (copies n, 3, 3), rows, copies, n, cache, out), launched by `launch_blocks`."""

    @_own.func_native(source(kind, False, dtype))
    def evaluate_rows(F, rows, copies, n, cache, out): ...

    @_own.kernel("unique", grid_stride=False)
    def analytic_evaluate(F, rows, copies, n, cache, out):
        evaluate_rows(F, rows, copies, n, cache, out)

    return analytic_evaluate


@cache
def vjp_kernel(kind: Kind, dtype: torch.dtype):
    """Kernel (F (copies n, 3, 3), rows, copies, n, cache, grad_out, grad_F, partials), launched by `launch_blocks`.

    It writes sums of the gradients of the coefficients over packs to partials (packs, COEFFICIENTS) if these are given.
    """

    @_own.func_native(source(kind, True, dtype))
    def vjp_rows(F, rows, copies, n, cache, grad_out, grad_F, partials): ...

    @_own.kernel("unique", grid_stride=False)
    def analytic_vjp(F, rows, copies, n, cache, grad_out, grad_F, partials):
        vjp_rows(F, rows, copies, n, cache, grad_out, grad_F, partials)

    return analytic_vjp


@cache
def flow_kernel(dtype: torch.dtype):
    """Kernel (F_trial, rows, elastic_rows, copies, n, cache, F, tau) of a return map and the stress after it."""

    @_own.func_native(source("flow", False, dtype))
    def evaluate_flow(F, rows, elastic_rows, copies, n, cache, out, stress_out): ...

    @_own.kernel("unique", grid_stride=False)
    def analytic_flow(F, rows, elastic_rows, copies, n, cache, out, stress_out):
        evaluate_flow(F, rows, elastic_rows, copies, n, cache, out, stress_out)

    return analytic_flow


@cache
def flow_vjp_kernel(dtype: torch.dtype):
    """Adjoint of `flow_kernel` for gradients of tau and of F, without the part of F through tau.

    The partials of both laws are as those of `vjp_kernel`.
    """

    @_own.func_native(source("flow", True, dtype))
    def vjp_flow(
        F, rows, elastic_rows, copies, n, cache, returned_F, grad_out, grad_stress, grad_F, partials,
        elastic_partials,
    ): ...  # fmt: skip

    @_own.kernel("unique", grid_stride=False)
    def analytic_flow_vjp(
        F, rows, elastic_rows, copies, n, cache, returned_F, grad_out, grad_stress, grad_F, partials,
        elastic_partials,
    ):  # fmt: skip
        vjp_flow(
            F, rows, elastic_rows, copies, n, cache, returned_F, grad_out, grad_stress, grad_F, partials,
            elastic_partials,
        )  # fmt: skip

    return analytic_flow_vjp


def kernel_of(
    kind: Kind, F: Tensor, rows: Tensor, backward: bool
) -> tuple[wp.Kernel, dict[str, Tensor | int]]:
    """Kernel and arguments of `Constitutive.kernel`."""
    kernel = vjp_kernel(kind, F.dtype) if backward else evaluate_kernel(kind, F.dtype)
    return kernel, {"rows": rows, "copies": len(rows), "n": len(F) // len(rows)}


def partial_shape(copies: int, n: int, F: Tensor) -> tuple[int, int, int]:
    """Shape (copies, packs, COEFFICIENTS) of the partials of a vjp for n rows like F of all copies."""
    return copies, pack_count(n // copies, F.device, CPU_WIDTH[F.dtype]), COEFFICIENTS


def _blocks(F: Tensor) -> int:
    """Thread blocks for the rows of F. On a CPU one thread processes all rows."""
    return 1 if F.device.type == "cpu" else -(-len(F) // THREADS)


def cache_shape(copies: int, n: int, F: Tensor) -> tuple[int, int, int]:
    """Shape (packs, KEPT, CPU_WIDTH) of memory for the SVD of n rows like F of all copies on a CPU."""
    return copies * pack_count(n // copies, F.device, CPU_WIDTH[F.dtype]), KEPT, CPU_WIDTH[F.dtype]


def new_cache(F: Tensor, copies: int) -> Tensor | None:
    """Memory for the SVD of F (copies n, 3, 3) on a CPU, None on a GPU."""
    return F.new_empty(cache_shape(copies, len(F), F)) if F.device.type == "cpu" else None


def evaluate(
    kind: Kind, F: Tensor, rows: Tensor, out: Tensor | None = None, cache: Tensor | None = None
) -> Tensor:
    """Stress or return map of F (copies n, 3, 3), of which each n rows follow one of rows (copies, 1 + COEFFICIENTS).

    Args:
        rows: of the dtype and device of F.
        out: (copies n, 3, 3), receives the result if given.
        cache: result of `new_cache`, receives the SVD if given.
    """
    F, rows = F.detach().contiguous(), rows.detach().contiguous()
    out = torch.empty_like(F) if out is None else out
    result = out if out.is_contiguous() else torch.empty_like(F)
    if len(F):
        inputs = F, rows, len(rows), len(F) // len(rows), cache, result
        launch_blocks(evaluate_kernel(kind, F.dtype), _blocks(F), THREADS, *inputs)
    return out if result is out else out.copy_(result)


def vjp(
    kind: Kind,
    F: Tensor,
    rows: Tensor,
    grad_out: Tensor,
    cache: Tensor | None = None,
    grad_F: Tensor | None = None,
    grad_rows: Tensor | None = None,
) -> Tensor:
    """Gradient of F. The gradient of ``rows`` is added to ``grad_rows`` (copies, 1 + COEFFICIENTS) if given.

    ``cache`` is that of `evaluate` for the same F. Sums over particles are in float64 in a fixed order.
    """
    F, rows, grad_out = (x.detach().contiguous() for x in (F, rows, grad_out))
    grad_F = torch.empty_like(F) if grad_F is None else grad_F
    result = grad_F if grad_F.is_contiguous() else torch.empty_like(F)
    if len(F):
        copies, n = len(rows), len(F) // len(rows)
        partials = None
        if grad_rows is not None:
            shape = partial_shape(copies, len(F), F)
            partials = torch.empty(shape, dtype=torch.float64, device=F.device)
        address = 0 if partials is None else partials.data_ptr()
        inputs = F, rows, copies, n, cache, grad_out, result, address
        launch_blocks(vjp_kernel(kind, F.dtype), _blocks(F), THREADS, *inputs)
        if partials is not None:
            grad_rows[:, 1:] += partials.sum(1)
    return grad_F if result is grad_F else grad_F.copy_(result)
