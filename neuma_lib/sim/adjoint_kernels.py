"""Adjoints of the transfers in ``kernels``, written by hand and run in the opposite order.

``grad_y`` is the derivative of the loss with respect to ``y``. Each kernel undoes one forward kernel: the adjoint
of a gather is a scatter over the same stencil and the other way round, so ``g2p_adjoint`` reads like P2G and
``p2g_adjoint`` like G2P. With d_i = x_i - x, and N' the slope of the B-spline, a weight moves by
dw_i/dx = N'_i and an offset by dd_i/dx = -I.
"""

# No `from __future__ import annotations` here: Warp reads the annotations of kernels as objects.
import functools
from types import SimpleNamespace

import torch
import warp as wp

from neuma_lib.sim.kernels import grid_functions, warp_types


@functools.cache
def adjoint_kernels(dtype: torch.dtype) -> SimpleNamespace:
    """Kernels ``g2p_adjoint``, ``grid_adjoint`` and ``p2g_adjoint`` for one precision."""
    t = warp_types(dtype)
    real, vec3, vec4, mat33, GridConstants = t.real, t.vec3, t.vec4, t.mat33, t.GridConstants
    functions = grid_functions(dtype)
    base_node, offset = functions.base_node, functions.offset
    wall_mask, moved_mask = functions.wall_mask, functions.moved_mask
    weights, slopes = functions.weights, functions.weight_slopes
    kernel = functools.partial(
        wp.kernel, enable_backward=False, module=f"neuma_lib.sim.adjoint_{str(dtype).removeprefix('torch.')}"
    )

    @kernel
    def g2p_adjoint(
        c: GridConstants,
        now: wp.int32,
        after: wp.int32,
        kept: wp.int32,
        x: wp.array2d(dtype=vec3),
        v: wp.array2d(dtype=vec3),
        C: wp.array2d(dtype=mat33),
        F: wp.array2d(dtype=mat33),
        grid_v: wp.array2d(dtype=vec4),
        grad_v: wp.array(dtype=vec3),
        grad_C: wp.array(dtype=mat33),
        grad_F_trial: wp.array(dtype=mat33),
        grad_x: wp.array(dtype=vec3),
        grad_F: wp.array(dtype=mat33),
        grad_grid_v: wp.array(dtype=vec4),
    ):
        """Gradients of (x, v, C)[after] and F_trial to those of grid_v (added), x (in place) and F (set)."""
        p = wp.tid()
        xp = x[now, p]
        bi = base_node(c, xp[0])
        bj = base_node(c, xp[1])
        bk = base_node(c, xp[2])
        f = xp * c.inv_dx - vec3(real(bi), real(bj), real(bk))
        w = weights(f)
        s = slopes(f)
        # F_trial = (I + dt C) F and x[after] = x + dt v pass their gradients to C, F and v ...
        gF_trial = grad_F_trial[p]
        grad_F[p] = gF_trial + c.dt * (wp.transpose(C[after, p]) * gF_trial)
        gC = grad_C[p] + c.dt * (gF_trial * wp.transpose(F[now, p]))
        g_moved = wp.cw_mul(moved_mask(c, x[after, p]), grad_x[p])
        gv = grad_v[p] + c.dt * g_moved
        # ... and node i, with v = sum w_i v_i and C = (4/dx^2) sum w_i v_i d_i^T, gets w_i u_i.
        D = (real(4.0) * c.inv_dx) * gC
        u0 = gv - D * f
        gx = vec3()
        for i in range(3):
            for j in range(3):
                row = ((bi + i) * c.n + bj + j) * c.n + bk
                for k in range(3):
                    u = u0 + D * offset(i, j, k)
                    weight = w[i, 0] * w[j, 1] * w[k, 2]
                    wp.atomic_add(grad_grid_v, row + k, weight * vec4(u[0], u[1], u[2], real(0.0)))
                    node = grid_v[kept, row + k]
                    uv = u[0] * node[0] + u[1] * node[1] + u[2] * node[2]
                    gx += uv * vec3(
                        s[i, 0] * w[j, 1] * w[k, 2], w[i, 0] * s[j, 1] * w[k, 2], w[i, 0] * w[j, 1] * s[k, 2]
                    )
        grad_x[p] = g_moved + c.inv_dx * (gx - wp.transpose(D) * v[after, p])

    @kernel
    def grid_adjoint(
        c: GridConstants, kept: wp.int32, grid: wp.array2d(dtype=vec4), grad_grid: wp.array(dtype=vec4)
    ):
        """In place: gradient of a node's velocity to the gradients of its momentum and mass."""
        node = wp.tid()
        mv = grid[kept, node]
        if mv[3] > real(0.0):
            v = vec3(mv[0], mv[1], mv[2]) / mv[3]
            g = grad_grid[node]
            g_mv = wp.cw_mul(vec3(g[0], g[1], g[2]), wall_mask(c, node, v + c.dt * c.gravity)) / mv[3]
            grad_grid[node] = vec4(g_mv[0], g_mv[1], g_mv[2], -wp.dot(g_mv, v))

    @kernel
    def p2g_adjoint(
        c: GridConstants,
        now: wp.int32,
        kept: wp.int32,
        x: wp.array2d(dtype=vec3),
        v: wp.array2d(dtype=vec3),
        C: wp.array2d(dtype=mat33),
        tau: wp.array2d(dtype=mat33),
        mass: wp.array(dtype=real),
        vol0: wp.array(dtype=real),
        grad_grid: wp.array(dtype=vec4),
        grad_x: wp.array(dtype=vec3),
        grad_v: wp.array(dtype=vec3),
        grad_C: wp.array(dtype=mat33),
        grad_tau: wp.array(dtype=mat33),
    ):
        """Gradients of the nodes' momentum and mass to those of x (in place), v, C and tau (set)."""
        p = wp.tid()
        xp = x[now, p]
        m = mass[p]
        bi = base_node(c, xp[0])
        bj = base_node(c, xp[1])
        bk = base_node(c, xp[2])
        f = xp * c.inv_dx - vec3(real(bi), real(bj), real(bk))
        w = weights(f)
        s = slopes(f)
        stress = real(4.0) * c.dt * vol0[p] * c.inv_dx * c.inv_dx
        A = (m * C[now, p] - stress * tau[kept, p]) * c.dx
        q0 = m * v[now, p] - A * f
        gq = vec3()  # sum w_i grad_(mv)_i
        gA = mat33()  # sum w_i grad_(mv)_i d_i^T / dx
        gx = vec3()
        for i in range(3):
            for j in range(3):
                row = ((bi + i) * c.n + bj + j) * c.n + bk
                for k in range(3):
                    node = grad_grid[row + k]
                    q = q0 + A * offset(i, j, k)
                    weight = w[i, 0] * w[j, 1] * w[k, 2]
                    wg = weight * vec3(node[0], node[1], node[2])
                    gq += wg
                    gA += wp.outer(wg, offset(i, j, k) - f)
                    qg = q[0] * node[0] + q[1] * node[1] + q[2] * node[2] + m * node[3]
                    gx += qg * vec3(
                        s[i, 0] * w[j, 1] * w[k, 2], w[i, 0] * s[j, 1] * w[k, 2], w[i, 0] * w[j, 1] * s[k, 2]
                    )
        gA = gA * c.dx
        grad_v[p] = m * gq
        grad_C[p] = m * gA
        grad_tau[p] = -stress * gA
        grad_x[p] = grad_x[p] + c.inv_dx * (gx - wp.transpose(A) * gq)

    return SimpleNamespace(g2p_adjoint=g2p_adjoint, grid_adjoint=grid_adjoint, p2g_adjoint=p2g_adjoint)
