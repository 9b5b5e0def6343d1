"""Access to records of splats and their gradients, ``SPLAT_SIZE`` numbers each, in groups of four.

Vector loads of 16 bytes avoid twelve uncoalesced accesses per record.
"""

import functools

import torch
import warp as wp

from neuma_lib.device import native_source, start_warp

start_warp()

SPLAT_SIZE = 12


@functools.cache
def functions(dtype: torch.dtype):
    """``(load, store)`` Warp functions for contiguous records (I, G, SPLAT_SIZE) of a dtype; piece 0, 1 or 2."""
    real = wp.dtype_from_torch(dtype)
    vec4 = wp.types.vector(4, real)

    def text(name: str) -> str:
        parts = native_source(__file__, ".h")
        source = (parts["piece"] + parts[name]).replace("SPLAT_SIZE", str(SPLAT_SIZE))
        return source.replace("REAL", {torch.float32: "float", torch.float64: "double"}[dtype])

    @wp.func_native(text("load"))
    def load(records: wp.array3d(dtype=real), image: int, g: int, piece: int) -> vec4: ...

    @wp.func_native(text("store"))
    def store(
        records: wp.array3d(dtype=real), image: int, g: int, piece: int, a: real, b: real, c: real, d: real
    ): ...

    return load, store
