"""Scatter from particles to grid nodes, which dominates the time of the transfers on a GPU.

The 27 contributions of a particle overlap with those of its neighbours. There are three methods:

- "native" (CPU): one thread adds them in the order of the particles, see `transfers`. All transfers differ with it.
- "atomic": every particle adds each of its numbers atomically, for both precisions, on CPU and GPU.
- "runs" (CUDA, float32): threads process particles sorted by cell, so that neighbours in a warp mostly share their 27
  nodes. The warp sums the contributions of each run of equal cells with shuffles, and the first thread of the run adds
  the sum, by whole nodes (16 bytes) on compute capability 9.0 or by single numbers. "runs_scalar" always adds single
  numbers, for tests. Sorting affects only the speed.
"""

import functools

import torch
import warp as wp

from neuma_lib.device import native_source, start_warp

start_warp()


def scatter_for(device: torch.device, dtype: torch.dtype) -> str:
    """The fastest scatter method for a device and precision."""
    if device.type == "cpu":
        return "native"
    return "runs" if dtype == torch.float32 else "atomic"


@functools.cache
def scatter_functions(dtype: torch.dtype, scatter: str, components: int) -> tuple[wp.Function, wp.Function]:
    """Functions `run_of` and `deposit` for kernels with one particle per thread.

    Args:
        scatter: "atomic", "runs" or "runs_scalar".
        components: 4 if nodes carry momentum and mass, 3 if the last of their four numbers stays zero.

    Returns:
        ``run_of(cell)`` takes the cell of the particle (-1: none), and ``deposit(rows, index, row, value, run)`` adds
        the matrix ``value`` (3 x 4) to the three nodes from ``row`` on of grid ``index``. All threads of a warp must
        call both.
    """
    real = {torch.float32: wp.float32, torch.float64: wp.float64}[dtype]
    mat34 = wp.types.matrix(shape=(3, 4), dtype=real)
    if scatter == "atomic":

        @wp.func
        def run_of(cell: wp.int32):
            return wp.int32(0)

        @wp.func
        def deposit(
            rows: wp.array2d(dtype=mat34), index: wp.int32, row: wp.int32, value: mat34, run: wp.int32
        ):
            wp.atomic_add(rows, index, row, value)

        return run_of, deposit

    if dtype != torch.float32:
        raise ValueError(f"scatter {scatter!r} is for float32, not {dtype}")
    vector = "1" if scatter == "runs" else "0"
    parts = native_source(__file__)
    snippet = parts["deposit"].replace("COMPONENTS", str(components)).replace("VECTOR", vector)

    @wp.func_native(parts["run"])
    def run_of_lanes(cell: wp.int32) -> wp.int32: ...

    @wp.func_native(snippet)
    def deposit_run(
        rows: wp.array2d(dtype=mat34), index: wp.int32, row: wp.int32, value: mat34, run: wp.int32
    ): ...

    return run_of_lanes, deposit_run
