"""Kernels of `singular_values`: the SVD of 3x3 matrices, written once for CPU lanes and CUDA threads.

An SVD is a long chain of dependent square roots and divisions, so on a CPU one matrix at a time leaves the
vector units idle. The text in ``singular_values_kernels.h`` works on a *pack*: 8 matrices, one per SIMD lane, on the
CPU (6 times faster than the same code for one matrix), and one matrix per thread on a GPU. It is C++ because Warp's
Python functions know no lanes. A kernel is the parts "types" and "pack", then :data:`LOAD`, :data:`SVD` and what
follows from it, and the part "end" (:func:`snippet`).
"""

from functools import cache

import torch
import warp as wp

from neuma_lib.device import native_source, start_warp

start_warp()

CPU_WIDTH = 8

SWEEPS = {torch.float32: 3, torch.float64: 4}
"""Cyclic Jacobi sweeps until the off-diagonal of A^T A is round-off; convergence is quadratic from the second on."""
_PARTS = native_source(__file__, ".h")
TYPES, LOAD, SVD, STORE, END = (_PARTS[name] for name in ("types", "load", "svd", "store", "end"))


def snippet(*parts: str, dtype: torch.dtype) -> str:
    """A kernel over packs of parts of C++, see `filled`."""
    return filled("".join((TYPES, _PARTS["pack"], *parts, END)), dtype)


def filled(text: str, dtype: torch.dtype) -> str:
    """C++ with the scalar type, the size of a pack and the number of Jacobi sweeps filled in."""
    text = text.replace("CPU_WIDTH", str(CPU_WIDTH)).replace("SWEEPS", str(SWEEPS[dtype]))
    return text.replace("REAL", {torch.float32: "float", torch.float64: "double"}[dtype])


def warp_types(dtype: torch.dtype):
    """Warp's scalar, 3-vector and 3x3 matrix types of a torch dtype (float32 or float64)."""
    if dtype == torch.float32:
        return wp.float32, wp.vec3f, wp.mat33f
    if dtype == torch.float64:
        return wp.float64, wp.vec3d, wp.mat33d
    raise TypeError(f"kernels exist for float32 and float64, not {dtype}")


def pack_count(n: int, device: torch.device) -> int:
    """Launch size for n matrices: packs on the CPU, matrices on a GPU."""
    return -(-n // CPU_WIDTH) if device.type == "cpu" else n


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
