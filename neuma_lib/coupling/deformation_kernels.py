"""Kernels of :mod:`neuma_lib.coupling.deformation`: sums over the particles of a Gaussian, and over the Gaussians of a
particle.

Both directions gather through a sparse matrix in CSR format, without atomic additions, so the result is deterministic.
Both sum rows of twelve contiguous numbers, a vector and a matrix (the vector and a zero if F needs no gradient).

On a CPU one native loop per frame packs, sums and deforms. On a GPU a thread sums four columns. Memory accesses are
coalesced: neighbouring threads read one row, 16 bytes each in float32, and write neighbouring results. Frames are the
slow index, so the rows of a frame stay in the cache while all its Gaussians read them, about seven times each.
"""

# No `from __future__ import annotations` here: Warp reads the annotations of kernels as objects.
import functools
from types import SimpleNamespace

import torch
import warp as wp

from neuma_lib.device import native_source, start_warp, typed
from neuma_lib.mechanics.singular_values_kernels import warp_types

start_warp()

PARTS = 3
"""Groups of four numbers in a row of a vector and a 3x3 matrix."""


@functools.cache
def frame_kernels(dtype: torch.dtype) -> SimpleNamespace:
    """Kernels ``forward`` and ``backward`` of a dtype on a CPU, over frames, which run one after the other."""
    real, _, _ = warp_types(dtype)
    module = wp.get_module(f"{__name__}.frames.{str(dtype).removeprefix('torch.')}")
    text = native_source(__file__, ".h")
    start = text["frames"].replace("REAL", {torch.float32: "float", torch.float64: "double"}[dtype])

    types = {
        **dict.fromkeys(("frame", "count", "particles"), int),
        "indptr": wp.array(dtype=int),  # rows of B, (G + 1,), in `backward` of B^T, (N + 1,)
        "indices": wp.array(dtype=int),
        "weights": wp.array(dtype=real),
        "means": wp.array2d(dtype=real),  # (G, 3)
        "covars": wp.array3d(dtype=real),  # (G, 3, 3)
        "arms": wp.array2d(dtype=real),  # (G, 3) or None
        "x0": wp.array2d(dtype=real),  # (N, 3)
        "x": wp.array3d(dtype=real),  # (T, N, 3)
        "F": wp.array4d(dtype=real),  # (T, N, 3, 3)
        "scratch": wp.array2d(dtype=real),  # (N, 12); in `backward` (G, 12), or (G, 4) if F needs no gradient
        "sums": wp.array3d(
            dtype=real
        ),  # (T, G, 12), out: mean shift and mean F of the particles; None without them
        "moved": wp.array3d(dtype=real),  # (T, G, 3), out
        "stretched": wp.array4d(dtype=real),  # (T, G, 3, 3), out
        "grad_moved": wp.array3d(dtype=real),  # (T, G, 3)
        "grad_stretched": wp.array4d(dtype=real),  # (T, G, 3, 3)
        "grad_x": wp.array3d(dtype=real),  # (T, N, 3), out
        "grad_F": wp.array4d(dtype=real),  # (T, N, 3, 3), out; None if F needs no gradient, as `sums` then
    }
    own = typed(types)
    kernel = own.kernel(module)

    @own.func_native(start + text["forward"])
    def forward_native(
        frame, count, particles, indptr, indices, weights, means, covars, arms, x0, x, F, scratch, sums, moved,
        stretched,
    ): ...  # fmt: skip

    @own.func_native(start + text["backward"])
    def backward_native(
        frame, count, particles, indptr, indices, weights, covars, arms, sums, grad_moved, grad_stretched, scratch,
        grad_x, grad_F,
    ): ...  # fmt: skip

    @kernel
    def forward(indptr, indices, weights, means, covars, arms, x0, x, F, scratch, sums, moved, stretched):
        forward_native(
            wp.tid(), moved.shape[1], x0.shape[0], indptr, indices, weights, means, covars, arms, x0, x, F, scratch,
            sums, moved, stretched,
        )  # fmt: skip

    @kernel
    def backward(
        indptr, indices, weights, covars, arms, sums, grad_moved, grad_stretched, scratch, grad_x, grad_F
    ):
        backward_native(
            wp.tid(), grad_moved.shape[1], grad_x.shape[1], indptr, indices, weights, covars, arms, sums, grad_moved,
            grad_stretched, scratch, grad_x, grad_F,
        )  # fmt: skip

    return SimpleNamespace(forward=forward, backward=backward)


@functools.cache
def kernels(dtype: torch.dtype) -> SimpleNamespace:
    """Kernels for a dtype on a GPU. A thread processes one frame and: a part of a row (`pack`, `weighted_sums`), a
    coordinate of a Gaussian (`carry`), or a Gaussian (`stretch_adjoint`).
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
    def pack(
        x0: wp.array(dtype=real),  # (3 N,)
        x: wp.array2d(dtype=real),  # (T, 3 N)
        F: wp.array2d(dtype=real),  # (T, 9 N)
        rows: wp.array2d(dtype=vec4),  # (T, 3 N), out: x - x0 and F of each particle
    ):
        t, place = wp.tid()
        j = place // PARTS
        part = place - j * PARTS
        value = vec4()
        for k in range(4):
            column = 4 * part + k
            if column < 3:
                value[k] = x[t, 3 * j + column] - x0[3 * j + column]
            else:
                value[k] = F[t, 9 * j + column - 3]
        put(rows, t, place, value)

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

    return SimpleNamespace(
        pack=pack, weighted_sums=weighted_sums, carry=carry, stretch_adjoint=stretch_adjoint
    )
