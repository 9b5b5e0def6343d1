"""Kernels of :mod:`neuma_lib.coupling.deformation`: sums over the particles of a Gaussian, and over the Gaussians of a
particle.

Both directions gather through a sparse matrix in CSR format, without atomic additions, so the result is deterministic.
Both sum rows of twelve contiguous numbers, a vector and a matrix (the vector and a zero if F needs no gradient).

A thread sums four columns. Memory accesses of a GPU are coalesced: neighbouring threads read one row, 16 bytes each in
float32, and write neighbouring results. Frames are the slow index, so the rows of a frame stay in the cache while all
its Gaussians read them, about seven times each.
"""

import functools
from types import SimpleNamespace

import torch
import warp as wp

from neuma_lib.device import native_source, start_warp
from neuma_lib.mechanics.singular_values_kernels import warp_types

start_warp()

PARTS = 3  # groups of four numbers in a row of a vector and a 3x3 matrix


@functools.cache
def kernels(dtype: torch.dtype) -> SimpleNamespace:
    """Kernels for a dtype. A thread processes one frame and: a part of a row (`weighted_sums`), a coordinate of a
    Gaussian (`carry`), or a Gaussian (`stretch_adjoint`).
    """
    real, vec3, mat33 = warp_types(dtype)
    vec4 = wp.types.vector(length=4, dtype=real)
    module = wp.get_module(f"{__name__}.{str(dtype).removeprefix('torch.')}")
    kernel = functools.partial(wp.kernel, enable_backward=False, module=module)
    text = native_source(__file__, ".h")
    quad = text["quad"].replace("REAL", {torch.float32: "float", torch.float64: "double"}[dtype])

    @wp.func_native(quad + text["get"])
    def get(rows: wp.array2d(dtype=vec4), frame: wp.int32, place: wp.int32) -> vec4: ...

    @wp.func_native(quad + text["put"])
    def put(rows: wp.array2d(dtype=vec4), frame: wp.int32, place: wp.int32, value: vec4): ...

    # sum of weights[k] rows[frame, indices[k] parts + part] over k from start to stop
    @wp.func_native(quad + text["sum"])
    def weighted_sum(
        indices: wp.array(dtype=wp.int32), weights: wp.array(dtype=real), start: wp.int32, stop: wp.int32,
        rows: wp.array2d(dtype=vec4), frame: wp.int32, parts: wp.int32, part: wp.int32,
    ) -> vec4: ...  # fmt: skip

    @wp.func
    def matrix_of(first: vec4, second: vec4, third: vec4):
        return mat33(
            first[3], second[0], second[1], second[2], second[3], third[0], third[1], third[2], third[3]
        )

    @wp.func
    def one_of(i: wp.int32, a: real, b: real, c: real):
        return wp.where(i == 0, a, wp.where(i == 1, b, c))

    @kernel
    def weighted_sums(
        indptr: wp.array(dtype=wp.int32),  # (K + 1,) rows of B or B^T
        indices: wp.array(dtype=wp.int32),
        weights: wp.array(dtype=real),
        rows: wp.array2d(dtype=vec4),  # (T, M parts)
        parts: wp.int32,
        sums: wp.array2d(dtype=vec4),  # (T, K parts), out
    ):
        t, place = wp.tid()
        i = place // parts
        part = place - i * parts
        put(sums, t, place, weighted_sum(indices, weights, indptr[i], indptr[i + 1], rows, t, parts, part))

    @kernel
    def carry(
        means: wp.array(dtype=real),  # (3 G,)
        covars: wp.array(dtype=mat33),  # (G,)
        arms: wp.array(dtype=vec3),  # (G,) or None
        sums: wp.array2d(dtype=vec4),  # (T, 3 G), mean shift and mean F of the particles
        moved: wp.array2d(dtype=real),  # (T, 3 G), out
        stretched: wp.array2d(dtype=vec3),  # (T, 3 G), out: rows of the covariances
    ):
        t, place = wp.tid()
        g = place // 3
        i = place - 3 * g
        first = get(sums, t, 3 * g)
        mean_F = matrix_of(first, get(sums, t, 3 * g + 1), get(sums, t, 3 * g + 2))
        row = wp.where(i == 0, mean_F[0], wp.where(i == 1, mean_F[1], mean_F[2]))
        shift = one_of(i, first[0], first[1], first[2])
        if arms:
            arm = arms[g]
            shift += wp.dot(row, arm) - one_of(i, arm[0], arm[1], arm[2])
        moved[t, place] = means[place] + shift
        stretched[t, place] = mean_F * (wp.transpose(covars[g]) * row)

    @kernel
    def stretch_adjoint(
        covars: wp.array(dtype=mat33),  # (G,)
        arms: wp.array(dtype=vec3),  # (G,) or None
        sums: wp.array2d(dtype=vec4),  # (T, 3 G), input of `carry`; None if F needs no gradient
        grad_moved: wp.array2d(dtype=vec3),  # (T, G)
        grad_stretched: wp.array2d(dtype=mat33),  # (T, G)
        grad_sums: wp.array2d(dtype=vec4),  # (T, 3 G), out; (T, G), vectors only, if F needs no gradient
    ):
        t, g = wp.tid()
        shift = grad_moved[t, g]
        if sums:
            mean_F = matrix_of(get(sums, t, 3 * g), get(sums, t, 3 * g + 1), get(sums, t, 3 * g + 2))
            grad = grad_stretched[t, g]
            A = covars[g]
            total = grad * mean_F * wp.transpose(A) + wp.transpose(grad) * mean_F * A
            if arms:
                total += wp.outer(shift, arms[g])
            put(grad_sums, t, 3 * g, vec4(shift[0], shift[1], shift[2], total[0, 0]))
            put(grad_sums, t, 3 * g + 1, vec4(total[0, 1], total[0, 2], total[1, 0], total[1, 1]))
            put(grad_sums, t, 3 * g + 2, vec4(total[1, 2], total[2, 0], total[2, 1], total[2, 2]))
        else:
            put(grad_sums, t, g, vec4(shift[0], shift[1], shift[2], real(0.0)))

    return SimpleNamespace(weighted_sums=weighted_sums, carry=carry, stretch_adjoint=stretch_adjoint)
