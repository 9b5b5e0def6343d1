"""Kernels of :mod:`neuma_lib.mechanics.neural` for the features and for the stress or return map.

The matrix products of the network stay in torch. X = sym(Y) is the symmetrised output.
"""

from functools import cache

import torch
import warp as wp

from neuma_lib.device import native_source
from neuma_lib.mechanics.singular_values_kernels import LOAD, SVD, snippet, warp_types

FEATURES = 13
_PARTS = native_source(__file__, ".h")
GRAM = _PARTS["gram"]
_STORE = _PARTS["store"].replace("FEATURES", str(FEATURES))


@cache
def feature_kernel(dtype: torch.dtype):
    """Kernel (F, z (n, 13), R, Vh, n) over packs: features and rotation. U = R V is not stored."""
    real, _, mat33 = warp_types(dtype)

    @wp.func_native(snippet(LOAD, GRAM, SVD, _STORE, dtype=dtype))
    def feature_pack(
        F: wp.array(dtype=mat33), z: wp.array2d(dtype=real), R: wp.array(dtype=mat33), Vh: wp.array(dtype=mat33),
        block: int, n: int,
    ): ...  # fmt: skip

    @wp.kernel(enable_backward=False, module="unique")
    def features(
        F: wp.array(dtype=mat33), z: wp.array2d(dtype=real), R: wp.array(dtype=mat33), Vh: wp.array(dtype=mat33),
        n: int,
    ):  # fmt: skip
        feature_pack(F, z, R, Vh, wp.tid(), n)

    return features


@cache
def output_kernels(dtype: torch.dtype, kind: str):
    """Kernels (result, output adjoint, input adjoint) of one dtype, for ``kind`` "elasticity" or "plasticity".

    Elasticity is tau = P F^T with P = R X, plasticity F + scale R X. With g the gradient of the result,

    - elasticity: grad_P = g F, and grad_F has the direct term g^T P; plasticity: grad_P = scale g, direct term g;
    - grad_R = grad_P X, grad_X = R^T grad_P, grad_Y = sym(grad_X);
    - ``input_adjoint`` adds the terms of grad_F from the rotation and the features.
    """
    real, vec3, mat33 = warp_types(dtype)
    half, one = real(0.5), real(1.0)
    floor = real(torch.finfo(dtype).eps ** 0.5)
    elastic = kind == "elasticity"

    @wp.func
    def symmetric(Y: mat33):
        return half * (Y + wp.transpose(Y))

    @wp.func
    def gradient_of_P(F: mat33, g: mat33, scale: real):
        if wp.static(elastic):
            return g * F
        return scale * g

    @wp.kernel(enable_backward=False, module="unique")
    def result(
        F: wp.array(dtype=mat33), R: wp.array(dtype=mat33), Y: wp.array(dtype=mat33), scale: real,
        out: wp.array(dtype=mat33),
    ):  # fmt: skip
        i = wp.tid()
        P = R[i] * symmetric(Y[i])
        if wp.static(elastic):
            out[i] = P * wp.transpose(F[i])
        else:
            out[i] = F[i] + scale * P

    @wp.kernel(enable_backward=False, module="unique")
    def output_adjoint(
        F: wp.array(dtype=mat33), R: wp.array(dtype=mat33), g: wp.array(dtype=mat33), scale: real,
        grad_Y: wp.array(dtype=mat33),
    ):  # fmt: skip
        i = wp.tid()
        grad_Y[i] = symmetric(wp.transpose(R[i]) * gradient_of_P(F[i], g[i], scale))

    @wp.kernel(enable_backward=False, module="unique")
    def input_adjoint(
        F: wp.array(dtype=mat33), R: wp.array(dtype=mat33), Vh: wp.array(dtype=mat33), z: wp.array2d(dtype=real),
        Y: wp.array(dtype=mat33), g: wp.array(dtype=mat33), grad_z: wp.array2d(dtype=real), scale: real,
        grad_F: wp.array(dtype=mat33),
    ):  # fmt: skip
        i = wp.tid()
        Fi = F[i]
        Ri = R[i]
        X = symmetric(Y[i])
        # rotation and singular values: U K Vh = R V K Vh, K_ij = (M_ij - M_ji) / (s_i + s_j), K_ii = grad
        # sigma_i, with M = U^T grad_R V = Vh (R^T grad_R) V
        W = Vh[i]
        M = W * (wp.transpose(Ri) * (gradient_of_P(Fi, g[i], scale) * X)) * wp.transpose(W)
        s0 = z[i, 0] + one
        s1 = z[i, 1] + one
        s2 = z[i, 2] + one
        d01 = s0 + s1
        d02 = s0 + s2
        d12 = s1 + s2
        if wp.abs(d12) < floor:
            d12 = wp.where(d12 < real(0.0), -floor, floor)
        if wp.abs(d02) < floor:
            d02 = wp.where(d02 < real(0.0), -floor, floor)
        if wp.abs(d01) < floor:
            d01 = wp.where(d01 < real(0.0), -floor, floor)
        k01 = (M[0, 1] - M[1, 0]) / d01
        k02 = (M[0, 2] - M[2, 0]) / d02
        k12 = (M[1, 2] - M[2, 1]) / d12
        K = mat33(grad_z[i, 0], k01, k02, -k01, grad_z[i, 1], k12, -k02, -k12, grad_z[i, 2])
        total = Ri * (wp.transpose(W) * K * W)
        # F^T F: F (G + G^T)
        G = mat33(
            grad_z[i, 3], grad_z[i, 4], grad_z[i, 5],
            grad_z[i, 6], grad_z[i, 7], grad_z[i, 8],
            grad_z[i, 9], grad_z[i, 10], grad_z[i, 11],
        )  # fmt: skip
        total += Fi * (G + wp.transpose(G))
        # det F: its cofactors, whose columns are cross products of the columns of F
        c0 = vec3(Fi[0, 0], Fi[1, 0], Fi[2, 0])
        c1 = vec3(Fi[0, 1], Fi[1, 1], Fi[2, 1])
        c2 = vec3(Fi[0, 2], Fi[1, 2], Fi[2, 2])
        total += grad_z[i, 12] * wp.matrix_from_cols(wp.cross(c1, c2), wp.cross(c2, c0), wp.cross(c0, c1))
        if wp.static(elastic):
            total += wp.transpose(g[i]) * (Ri * X)
        else:
            total += g[i]
        grad_F[i] = total

    return result, output_adjoint, input_adjoint
