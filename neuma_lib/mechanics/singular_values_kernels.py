"""Kernels of `singular_values`: the SVD of 3x3 matrices for CPU lanes and CUDA threads.

An SVD is a long sequence of dependent square roots and divisions, which leaves the vector units of a CPU idle if it
processes one matrix at a time. ``singular_values_kernels.h`` processes a *pack*: 8 or 16 matrices, one per SIMD lane,
on a CPU (6 times faster), and one matrix per thread on a GPU. It is C++ because Warp's Python functions have no lanes.
:func:`snippet` composes a kernel of these parts.
"""

from functools import cache

import torch
import warp as wp

from neuma_lib.device import native_source, start_warp

start_warp()

CPU_WIDTH = {torch.float32: 16, torch.float64: 8}
"""Matrices in a pack on a CPU: 512 bits, as several registers on a CPU whose registers are smaller."""

SWEEPS = {torch.float32: 3, torch.float64: 4}
"""Cyclic Jacobi sweeps that reduce the off-diagonal of A^T A to round-off (quadratic convergence from the second)."""
_PARTS = native_source(__file__, ".h")
FUSE, MATH, MATRICES, LOAD, SVD, STORE, END = (
    _PARTS[name] for name in ("fuse", "math", "matrices", "load", "svd", "store", "end")
)
TYPES = _PARTS["types"] + MATRICES


def snippet(*parts: str, dtype: torch.dtype) -> str:
    """C++ source of a kernel over packs from its parts, usually `LOAD`, `SVD` and code that uses the result."""
    return filled("".join((FUSE, TYPES, _PARTS["pack"], *parts, END)), dtype)


def filled(text: str, dtype: torch.dtype, width: int | None = None) -> str:
    """C++ source with the scalar type, the size of a pack (default `CPU_WIDTH`) and the number of Jacobi sweeps."""
    text = text.replace("CPU_WIDTH", str(width or CPU_WIDTH[dtype])).replace("SWEEPS", str(SWEEPS[dtype]))
    return text.replace("REAL", {torch.float32: "float", torch.float64: "double"}[dtype])


def warp_types(dtype: torch.dtype):
    """Warp's scalar, 3-vector and 3x3 matrix types of a torch dtype (float32 or float64)."""
    if dtype == torch.float32:
        return wp.float32, wp.vec3f, wp.mat33f
    if dtype == torch.float64:
        return wp.float64, wp.vec3d, wp.mat33d
    raise TypeError(f"kernels exist for float32 and float64, not {dtype}")


def pack_count(n: int, device: torch.device, width: int) -> int:
    """Launch size for n matrices: packs of a width on a CPU, matrices on a GPU."""
    return -(-n // width) if device.type == "cpu" else n


@cache
def svd_kernel(dtype: torch.dtype):
    """Kernel (F, U, sigma, Vh, n), launched over :func:`pack_count` packs."""
    _, vec3, mat33 = warp_types(dtype)

    @wp.func_native(snippet(LOAD, SVD, STORE, dtype=dtype))
    def svd_pack(
        F: wp.array(dtype=mat33), U: wp.array(dtype=mat33), sigma: wp.array(dtype=vec3), Vh: wp.array(dtype=mat33),
        block: int, n: int,
    ): ...  # fmt: skip

    @wp.kernel(enable_backward=False, module="unique")
    def svd3(
        F: wp.array(dtype=mat33), U: wp.array(dtype=mat33), sigma: wp.array(dtype=vec3), Vh: wp.array(dtype=mat33),
        n: int,
    ):  # fmt: skip
        svd_pack(F, U, sigma, Vh, wp.tid(), n)

    return svd3
