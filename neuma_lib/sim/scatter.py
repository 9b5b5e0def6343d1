"""How particles add to the nodes of the grid: the part of the transfers that decides their speed on a GPU.

A particle's 27 contributions meet those of its neighbours, so they are added atomically. Two ways:

- "atomic": every particle adds each of its numbers. Right everywhere, in both precisions, on CPU and GPU.
- "runs" (CUDA, float32): threads take particles sorted by cell, so that neighbours in a warp mostly share
  their 27 nodes. The warp first sums the contributions of each run of equal cells with shuffles, and the first
  thread of the run adds the sum, a whole node (16 bytes) at a time where the hardware can (compute capability
  9.0), else number by number. "runs_scalar" is the latter everywhere, for tests. The result does not depend on
  how well the particles are sorted, only the speed does.
"""

# No `from __future__ import annotations` here: Warp reads the annotations of functions as objects.
import functools
from types import SimpleNamespace

import torch
import warp as wp

from neuma_lib.device import native_source, start_warp

start_warp()


def scatter_for(device: torch.device, dtype: torch.dtype) -> str:
    """The fastest way to scatter in a precision on a device."""
    return "runs" if device.type == "cuda" and dtype == torch.float32 else "atomic"


@functools.cache
def scatter_functions(dtype: torch.dtype, scatter: str, components: int) -> SimpleNamespace:
    """Functions for kernels whose threads each hold one particle.

    Args:
        dtype: precision.
        scatter: "atomic", "runs" or "runs_scalar".
        components: 4 where nodes carry momentum and mass, 3 where the last of their four numbers stays zero.

    Returns:
        ``run_of(cell)``, called once by all threads of a warp with the particle's cell (-1: no particle), and
        ``deposit(rows, index, row, value, run)``, which adds the matrix ``value`` (3 x 4) to three nodes from
        ``row`` on in a index of the grid, likewise called by all threads of a warp.
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

        return SimpleNamespace(run_of=run_of, deposit=deposit)

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

    return SimpleNamespace(run_of=run_of_lanes, deposit=deposit_run)
