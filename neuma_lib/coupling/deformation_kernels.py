"""Kernels of :mod:`neuma_lib.coupling.deformation`: sums over the particles of a Gaussian, and over the Gaussians of a
particle.

Both directions gather through a compressed sparse matrix, so nothing is added atomically and equal inputs give equal
bits. Frames are the slow index: the particles of one frame (48 bytes each) stay in the cache while all its Gaussians
read them, about seven times each.
"""

# No `from __future__ import annotations` here: Warp reads the annotations of kernels as objects.
import functools

import torch
import warp as wp

from neuma_lib.device import start_warp
from neuma_lib.mechanics.singular_values_kernels import warp_types

start_warp()


@functools.cache
def kernels(dtype: torch.dtype):
    """``(carry, stretch_adjoint, carry_adjoint)`` of a dtype; the first two run over (T, G), the last over (T, N)."""
    real, vec3, mat33 = warp_types(dtype)
    module = wp.get_module(f"{__name__}.{str(dtype).removeprefix('torch.')}")
    kernel = functools.partial(wp.kernel, enable_backward=False, module=module)

    @kernel
    def carry(
        indptr: wp.array(dtype=wp.int32),  # (G + 1,) rows of B
        indices: wp.array(dtype=wp.int32),
        weights: wp.array(dtype=real),
        means: wp.array(dtype=vec3),  # (G,)
        covars: wp.array(dtype=mat33),  # (G,)
        x0: wp.array(dtype=vec3),  # (N,)
        x: wp.array2d(dtype=vec3),  # (T, N)
        F: wp.array2d(dtype=mat33),  # (T, N)
        arms: wp.array(dtype=vec3),  # (G,); None: Gaussians only shift
        moved: wp.array2d(dtype=vec3),  # (T, G), out
        stretched: wp.array2d(dtype=mat33),  # (T, G), out
        F_bar: wp.array2d(dtype=mat33),  # (T, G), out; None where nobody needs it
    ):
        t, g = wp.tid()
        shift = vec3()
        mean_F = mat33()
        for k in range(indptr[g], indptr[g + 1]):
            j = indices[k]
            shift += weights[k] * (x[t, j] - x0[j])
            mean_F += weights[k] * F[t, j]
        if arms:
            shift += mean_F * arms[g] - arms[g]
        moved[t, g] = means[g] + shift
        stretched[t, g] = mean_F * covars[g] * wp.transpose(mean_F)
        if F_bar:
            F_bar[t, g] = mean_F

    @kernel
    def stretch_adjoint(
        covars: wp.array(dtype=mat33),  # (G,)
        F_bar: wp.array2d(dtype=mat33),  # (T, G)
        grad_stretched: wp.array2d(dtype=mat33),  # (T, G)
        arms: wp.array(dtype=vec3),  # (G,) or None
        grad_moved: wp.array2d(dtype=vec3),  # (T, G)
        grad_F_bar: wp.array2d(dtype=mat33),  # (T, G), out
    ):
        t, g = wp.tid()
        grad = grad_stretched[t, g]
        A = covars[g]
        total = grad * F_bar[t, g] * wp.transpose(A) + wp.transpose(grad) * F_bar[t, g] * A
        if arms:
            total += wp.outer(grad_moved[t, g], arms[g])
        grad_F_bar[t, g] = total

    @kernel
    def carry_adjoint(
        indptr: wp.array(dtype=wp.int32),  # (N + 1,) rows of B^T
        indices: wp.array(dtype=wp.int32),
        weights: wp.array(dtype=real),
        grad_moved: wp.array2d(dtype=vec3),  # (T, G)
        grad_F_bar: wp.array2d(dtype=mat33),  # (T, G); None together with grad_F
        grad_x: wp.array2d(dtype=vec3),  # (T, N), out
        grad_F: wp.array2d(dtype=mat33),  # (T, N), out
    ):
        t, j = wp.tid()
        total_x = vec3()
        total_F = mat33()
        for k in range(indptr[j], indptr[j + 1]):
            g = indices[k]
            total_x += weights[k] * grad_moved[t, g]
            if grad_F:
                total_F += weights[k] * grad_F_bar[t, g]
        grad_x[t, j] = total_x
        if grad_F:
            grad_F[t, j] = total_F

    return carry, stretch_adjoint, carry_adjoint
