"""Gather from grid nodes: the sums over the stencil of a particle in g2p and in the adjoint of p2g."""

import functools

import torch
import warp as wp

from neuma_lib.device import native_source, start_warp

start_warp()


@functools.cache
def gather_functions(dtype: torch.dtype) -> tuple[wp.Function, wp.Function]:
    """Functions `gather` and `three_nodes` for kernels with one particle per thread.

    ``gather(rows, index, row, n, wi, wj, wk, wd_i, wd_j, wd_k)`` returns a 4 x 4 matrix whose rows are the sums of w q,
    w q d_i, w q d_j and w q d_k over the 27 nodes. q are the four numbers of a node, w = wi wj wk is its weight and d
    its offset from the particle. ``wd_i`` holds the products of weights and offsets along an axis. ``row`` is the first
    node of the particle in the grid ``index``, which has ``n`` nodes along an edge.

    ``three_nodes(rows, index, row)`` is ``rows[index, row]``, loaded by whole nodes.
    """
    real = {torch.float32: wp.float32, torch.float64: wp.float64}[dtype]
    vec3 = wp.types.vector(length=3, dtype=real)
    mat34, mat44 = (wp.types.matrix(shape=(rows, 4), dtype=real) for rows in (3, 4))
    parts = native_source(__file__, ".h")
    name, vector = {torch.float32: ("float", "1"), torch.float64: ("double", "0")}[dtype]
    node = parts["node"].replace("REAL", name).replace("VECTOR", vector)

    @wp.func_native(node + parts["gather"] + parts["end"])
    def gather(
        rows: wp.array2d(dtype=mat34), index: wp.int32, row: wp.int32, n: wp.int32,
        wi: vec3, wj: vec3, wk: vec3, wd_i: vec3, wd_j: vec3, wd_k: vec3,
    ) -> mat44: ...  # fmt: skip

    @wp.func_native(node + parts["three"] + parts["end"])
    def three_nodes(rows: wp.array2d(dtype=mat34), index: wp.int32, row: wp.int32) -> mat34: ...

    return gather, three_nodes
