"""Warp kernel of a substep of a network of springs, and its hand-written adjoint.

Anchors have unit mass. A substep is semi-implicit Euler, v <- v + dt (f(x, v) + g), x <- x + dt v, followed by contact
with the planes of the box, moved inwards by a gap: a coordinate beyond a plane is set to it and its velocity to zero,
and friction scales the other velocity components.

Anchor i has a list of neighbours j and a stiffness k_i (Spring-Gaus, Zhong et al. 2024):

    f_i = sum_j [ eta_j (k_i / l_ij) (L - l_ij) (1 + |L / l_ij - 1|)^p + (c / l_ij) (v_j - v_i) . n ] n

with L n = x_j - x_i and the rest length l_ij. Elongations below `SLACK` have no force, as in the authors' code.
"""

import functools
from types import SimpleNamespace

import torch
import warp as wp

from neuma_lib.device import start_warp, typed

start_warp()

SLACK = 1e-6  # elongation below which a spring has no force [m]
MIN_LENGTH = 1e-12  # distance of two anchors below which their direction is undefined [m]


@functools.cache
def warp_types(dtype: torch.dtype) -> SimpleNamespace:
    """Warp's scalar and vector types for a torch precision, and the struct of constants."""
    real = wp.dtype_from_torch(dtype)
    types = SimpleNamespace(real=real, vec3=wp.types.vector(3, real))

    @wp.struct
    class SpringConstants:
        dt: real  # [s]
        gravity: types.vec3  # [m/s^2]
        low: real  # coordinates of the planes on every axis [m]
        high: real
        exponent: real

    types.SpringConstants = SpringConstants
    return types


@functools.cache
def kernels(dtype: torch.dtype) -> SimpleNamespace:
    """Kernels `step` and `step_adjoint` over the anchors."""
    t = warp_types(dtype)
    real, vec3, SpringConstants = t.real, t.vec3, t.SpringConstants
    module = wp.get_module(f"{__name__}.{str(dtype).removeprefix('torch.')}")
    types = {
        "c": SpringConstants,
        "now": wp.int32,
        "after_side": wp.int32,
        "neighbours": wp.array2d(dtype=wp.int32),  # (A, K)
        "rest": wp.array2d(dtype=real),  # (A, K)
        "stiffness": wp.array(dtype=real),  # (A,)
        "eta": wp.array(dtype=real),  # (K,)
        **dict.fromkeys(("damping", "friction", "gap"), wp.array(dtype=real)),  # (1,)
        **dict.fromkeys(("x", "v"), wp.array2d(dtype=vec3)),  # (S + 1, A)
        # (2, A): gradient of the state after the step, and zeros
        **dict.fromkeys(("grad_x", "grad_v"), wp.array2d(dtype=vec3)),
        # accumulated: (A,), and (A, K), contribution of each anchor
        **dict.fromkeys(
            ("grad_stiffness", "grad_damping", "grad_friction", "grad_gap"), wp.array(dtype=real)
        ),
        "grad_eta": wp.array2d(dtype=real),
    }
    kernel = typed(types).kernel(module)

    @wp.func(module=module)
    def power(u: real, p: real):
        """u^p. The published exponent 1/2 uses the square root, which is several times faster."""
        result = wp.sqrt(u)
        if p != real(0.5):
            result = wp.pow(u, p)
        return result

    @wp.func(module=module)
    def effective(elongation: real):
        """Elongation, zero below `SLACK`."""
        result = elongation
        if wp.abs(elongation) < real(wp.static(SLACK)):
            result = real(0.0)
        return result

    @wp.func(module=module)
    def beyond(c: SpringConstants, gap: real, x: vec3):
        """Per coordinate: 1 on or beyond the lower plane, -1 for the upper plane, 0 between them."""
        result = vec3()
        for a in range(3):
            if x[a] <= c.low + gap:
                result[a] = real(1.0)
            elif x[a] >= c.high - gap:
                result[a] = real(-1.0)
        return result

    @kernel
    def step(c, now, neighbours, rest, stiffness, eta, damping, friction, gap, x, v):
        i = wp.tid()
        xi, vi, ki, damp = x[now, i], v[now, i], stiffness[i], damping[0]
        force = vec3()
        for slot in range(neighbours.shape[1]):
            j = neighbours[i, slot]
            d = x[now, j] - xi
            length = wp.length(d)
            if length > real(wp.static(MIN_LENGTH)):
                n = d / length
                per_rest = real(1.0) / rest[i, slot]
                elongation = length - rest[i, slot]
                u = real(1.0) + wp.abs(elongation) * per_rest
                pull = eta[slot] * ki * effective(elongation) * power(u, c.exponent)
                force += (per_rest * (pull + damp * wp.dot(v[now, j] - vi, n))) * n
        v_new = vi + c.dt * (force + c.gravity)
        x_new = xi + c.dt * v_new
        hit = beyond(c, gap[0], x_new)
        kept = real(1.0)
        for _ in range(wp.int32(wp.dot(hit, hit))):
            kept *= friction[0]
        for a in range(3):
            v_new[a] *= kept * (real(1.0) - wp.abs(hit[a]))
            if hit[a] != real(0.0):
                x_new[a] = wp.clamp(x_new[a], c.low + gap[0], c.high - gap[0])
        x[now + 1, i] = x_new
        v[now + 1, i] = v_new

    @kernel
    def step_adjoint(
        c, now, after_side, neighbours, rest, stiffness, eta, damping, friction, gap, x, v, grad_x, grad_v,
        grad_stiffness, grad_eta, grad_damping, grad_friction, grad_gap,
    ):  # fmt: skip
        """From gradients of the state after a step (cleared) to those of the state before it.

        Threads add to the gradients of neighbours, on a GPU in no fixed order.
        """
        i = wp.tid()
        before = 1 - after_side
        xi, vi, ki, damp, kept = x[now, i], v[now, i], stiffness[i], damping[0], friction[0]
        hit = beyond(c, gap[0], x[now + 1, i])
        grad_gap[i] = grad_gap[i] + wp.dot(hit, grad_x[after_side, i])
        free = vec3(real(1.0), real(1.0), real(1.0)) - wp.cw_mul(hit, hit)
        g_x = wp.cw_mul(free, grad_x[after_side, i])
        g_after = wp.cw_mul(free, grad_v[after_side, i])
        grad_x[after_side, i] = vec3()
        grad_v[after_side, i] = vec3()
        planes = wp.int32(wp.dot(hit, hit))
        passed, slope = real(1.0), real(0.0)  # kept^planes and its derivative
        for _ in range(planes):
            slope = slope * kept + passed
            passed *= kept
        g_v = passed * g_after + c.dt * g_x  # gradient of the velocity before contact
        a = c.dt * g_v  # gradient of the force
        force, own_x, own_v = vec3(), g_x, g_v
        of_stiffness, of_damping = real(0.0), real(0.0)
        for slot in range(neighbours.shape[1]):
            j = neighbours[i, slot]
            d = x[now, j] - xi
            length = wp.length(d)
            if length > real(wp.static(MIN_LENGTH)):
                n = d / length
                per_rest = real(1.0) / rest[i, slot]
                strain = (length - rest[i, slot]) * per_rest
                u = real(1.0) + wp.abs(strain)
                shape = effective(length - rest[i, slot]) * per_rest * power(u, c.exponent)
                dv = v[now, j] - vi
                rate = per_rest * wp.dot(dv, n)
                size = eta[slot] * ki * shape + damp * rate
                force += size * n
                g_size = wp.dot(a, n)
                of_stiffness += g_size * eta[slot] * shape
                grad_eta[i, slot] = grad_eta[i, slot] + g_size * ki * shape
                of_damping += g_size * rate
                g_length = real(0.0)
                if shape != real(0.0):  # d shape / d length
                    g_length = g_size * eta[slot] * ki * per_rest * power(u, c.exponent)
                    g_length *= real(1.0) + c.exponent * wp.abs(strain) / u
                g_n = size * a + (g_size * damp * per_rest) * dv
                g_d = g_length * n + (g_n - wp.dot(g_n, n) * n) / length
                g_dv = (g_size * damp * per_rest) * n
                own_x -= g_d
                own_v -= g_dv
                wp.atomic_add(grad_x, before, j, g_d)
                wp.atomic_add(grad_v, before, j, g_dv)
        wp.atomic_add(grad_x, before, i, own_x)
        wp.atomic_add(grad_v, before, i, own_v)
        grad_stiffness[i] = grad_stiffness[i] + of_stiffness
        grad_damping[i] = grad_damping[i] + of_damping
        if planes > 0:
            reached = vi + c.dt * (force + c.gravity)
            grad_friction[i] = grad_friction[i] + slope * wp.dot(g_after, reached)

    return SimpleNamespace(step=step, step_adjoint=step_adjoint)
