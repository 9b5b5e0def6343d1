"""The three transfers of the material point method as Warp kernels: particles to grid, grid, grid to particles.

MLS-MPM (Hu et al. 2018) with quadratic B-splines and the affine velocity ``C`` of APIC (Jiang et al. 2015); the
order and the letters are those of the paper's Algorithm 2 (appendix "Introduction to the Material Point Method").

Every array of particles has a leading axis of slots: a rollout that will be differentiated gives each step a slot
of its own, any other one alternates between two. A grid node is one 4-vector, momentum and mass (``grid``) or
velocity and an indicator of mass (``grid_v``), so that a node costs one load and one store.

Kernels are made once per precision by :func:`forward_kernels`; their adjoints are in ``adjoint_kernels``.
"""

# No `from __future__ import annotations` here: Warp reads the annotations of kernels as objects.
import functools
from types import SimpleNamespace

import torch
import warp as wp

from neuma_lib import warp_setup

warp_setup.init()

NO_SLIP, SLIP, STICKY = 0, 1, 2
"""Codes of the boundary conditions in ``GridConstants.walls``."""

NEVER = 2**62
"""Value of a fault flag while nothing has gone wrong."""


@functools.cache
def warp_types(dtype: torch.dtype) -> SimpleNamespace:
    """Warp's scalar, vector and matrix types for a torch precision, and the struct of model constants."""
    real = {torch.float32: wp.float32, torch.float64: wp.float64}[dtype]
    vec3 = wp.types.vector(length=3, dtype=real)
    vec4 = wp.types.vector(length=4, dtype=real)
    mat33 = wp.types.matrix(shape=(3, 3), dtype=real)
    walls6 = wp.types.vector(length=6, dtype=wp.int32)

    @wp.struct
    class GridConstants:
        n: wp.int32  # nodes along an edge
        wall_cells: wp.int32  # thickness of the walls [nodes]
        walls: walls6  # condition on x_min, x_max, y_min, y_max, z_min, z_max
        dx: real  # node spacing [m]
        inv_dx: real
        dt: real  # [s]
        gravity: vec3  # [m/s^2]
        x_low: real  # a quadratic stencil fits the grid for x_low <= x <= x_high [m]
        x_high: real

    return SimpleNamespace(real=real, vec3=vec3, vec4=vec4, mat33=mat33, walls6=walls6, GridConstants=GridConstants)


@functools.cache
def grid_functions(dtype: torch.dtype) -> SimpleNamespace:
    """Functions that the transfers and their adjoints share: interpolation stencil and wall condition."""
    t = warp_types(dtype)
    real, vec3, mat33, GridConstants = t.real, t.vec3, t.mat33, t.GridConstants

    @wp.func
    def base_node(c: GridConstants, x: real):
        """First of the three nodes that see coordinate x; clamped, so that no fault indexes outside the grid."""
        return wp.clamp(wp.int32(x * c.inv_dx - real(0.5)), 0, c.n - 3)

    @wp.func
    def offset(i: wp.int32, j: wp.int32, k: wp.int32):
        """Position of a node of the stencil relative to its base [dx]. (A function, because Warp 1.19 changes the
        type of an unrolled loop's variable that is cast to float64 in place.)"""
        return vec3(real(i), real(j), real(k))

    @wp.func
    def weights(f: vec3):
        """Quadratic B-spline N at the three nodes (rows) of each axis (columns); f: distance to the base [dx]."""
        w = mat33()
        for a in range(3):
            w[0, a] = real(0.5) * (real(1.5) - f[a]) * (real(1.5) - f[a])
            w[1, a] = real(0.75) - (f[a] - real(1.0)) * (f[a] - real(1.0))
            w[2, a] = real(0.5) * (f[a] - real(0.5)) * (f[a] - real(0.5))
        return w

    @wp.func
    def weight_slopes(f: vec3):
        """Derivative of :func:`weights` with respect to f."""
        w = mat33()
        for a in range(3):
            w[0, a] = f[a] - real(1.5)
            w[1, a] = real(2.0) - real(2.0) * f[a]
            w[2, a] = f[a] - real(0.5)
        return w

    @wp.func
    def wall_mask(c: GridConstants, node: wp.int32, v: vec3):
        """1 for each component of the node's velocity v that the walls let pass, 0 for the others."""
        mask = vec3(real(1.0), real(1.0), real(1.0))
        place = node
        for axis in range(3):
            a = 2 - axis  # the last axis runs fastest
            i = place % c.n
            place = place / c.n
            for side in range(2):
                inside = i < c.wall_cells
                towards = v[a] < real(0.0)
                if side == 1:
                    inside = i >= c.n - c.wall_cells
                    towards = v[a] > real(0.0)
                if inside:
                    condition = c.walls[2 * a + side]
                    if condition == wp.static(STICKY) or (condition == wp.static(NO_SLIP) and towards):
                        mask = vec3()
                    elif condition == wp.static(SLIP) and towards:
                        mask[a] = real(0.0)
        return mask

    @wp.func
    def moved(c: GridConstants, x: vec3, v: vec3):
        """Position after a step, kept where the stencil exists: soft bodies are pressed past the last free node."""
        return wp.max(wp.min(x + c.dt * v, vec3(c.x_high)), vec3(c.x_low))

    @wp.func
    def moved_mask(c: GridConstants, x_new: vec3):
        """Derivative of :func:`moved` with respect to its unclamped argument: 0 for each component at a bound."""
        mask = vec3()
        for a in range(3):
            if x_new[a] > c.x_low and x_new[a] < c.x_high:
                mask[a] = real(1.0)
        return mask

    return SimpleNamespace(
        base_node=base_node,
        offset=offset,
        weights=weights,
        weight_slopes=weight_slopes,
        wall_mask=wall_mask,
        moved=moved,
        moved_mask=moved_mask,
    )


@functools.cache
def forward_kernels(dtype: torch.dtype) -> SimpleNamespace:
    """Kernels ``p2g``, ``grid_update``, ``g2p``, ``trial_deformation`` and ``advect_tracers`` for one precision."""
    t = warp_types(dtype)
    real, vec3, vec4, mat33, GridConstants = t.real, t.vec3, t.vec4, t.mat33, t.GridConstants
    functions = grid_functions(dtype)
    base_node, offset, weights = functions.base_node, functions.offset, functions.weights
    wall_mask, moved = functions.wall_mask, functions.moved
    kernel = functools.partial(
        wp.kernel, enable_backward=False, module=f"neuma_lib.sim.forward_{str(dtype).removeprefix('torch.')}"
    )

    @kernel
    def p2g(
        c: GridConstants,
        now: wp.int32,
        kept: wp.int32,
        x: wp.array2d(dtype=vec3),
        v: wp.array2d(dtype=vec3),
        C: wp.array2d(dtype=mat33),
        tau: wp.array2d(dtype=mat33),
        mass: wp.array(dtype=real),
        vol0: wp.array(dtype=real),
        grid: wp.array2d(dtype=vec4),
    ):
        """m_i += w m;  (m v)_i += w (m v + A d_i),  A = m C - dt vol0 (4/dx^2) tau,  d_i = x_i - x."""
        p = wp.tid()
        xp = x[now, p]
        m = mass[p]
        bi = base_node(c, xp[0])
        bj = base_node(c, xp[1])
        bk = base_node(c, xp[2])
        f = xp * c.inv_dx - vec3(real(bi), real(bj), real(bk))
        w = weights(f)
        A = (m * C[now, p] - (real(4.0) * c.dt * vol0[p] * c.inv_dx * c.inv_dx) * tau[kept, p]) * c.dx
        q0 = m * v[now, p] - A * f
        for i in range(3):
            for j in range(3):
                row = ((bi + i) * c.n + bj + j) * c.n + bk
                for k in range(3):
                    q = q0 + A * offset(i, j, k)
                    weight = w[i, 0] * w[j, 1] * w[k, 2]
                    wp.atomic_add(grid, kept, row + k, weight * vec4(q[0], q[1], q[2], m))

    @kernel
    def grid_update(
        c: GridConstants, kept: wp.int32, grid: wp.array2d(dtype=vec4), grid_v: wp.array2d(dtype=vec4)
    ):
        """v_i = (m v)_i / m_i + dt g where there is mass, then the walls; no small number is added to the mass."""
        node = wp.tid()
        mv = grid[kept, node]
        result = vec4()
        if mv[3] > real(0.0):
            v = vec3(mv[0], mv[1], mv[2]) / mv[3] + c.dt * c.gravity
            v = wp.cw_mul(v, wall_mask(c, node, v))
            result = vec4(v[0], v[1], v[2], real(1.0))
        grid_v[kept, node] = result

    @kernel
    def g2p(
        c: GridConstants,
        now: wp.int32,
        after: wp.int32,
        kept: wp.int32,
        step: wp.int32,
        grid_v: wp.array2d(dtype=vec4),
        x: wp.array2d(dtype=vec3),
        v: wp.array2d(dtype=vec3),
        C: wp.array2d(dtype=mat33),
        F: wp.array2d(dtype=mat33),
        F_trial: wp.array2d(dtype=mat33),
        faults: wp.array(dtype=wp.int64),
    ):
        """v = sum w v_i;  C = (4/dx^2) sum w v_i d_i^T;  x += dt v, clamped;  F_trial = (I + dt C) F."""
        p = wp.tid()
        xp = x[now, p]
        bi = base_node(c, xp[0])
        bj = base_node(c, xp[1])
        bk = base_node(c, xp[2])
        f = xp * c.inv_dx - vec3(real(bi), real(bj), real(bk))
        w = weights(f)
        v_new = vec3()
        B = mat33()
        for i in range(3):
            for j in range(3):
                row = ((bi + i) * c.n + bj + j) * c.n + bk
                for k in range(3):
                    node = grid_v[kept, row + k]
                    weight = w[i, 0] * w[j, 1] * w[k, 2]
                    wv = weight * vec3(node[0], node[1], node[2])
                    v_new += wv
                    B += wp.outer(wv, offset(i, j, k) - f)
        C_new = (real(4.0) * c.inv_dx) * B
        x_new = moved(c, xp, v_new)
        x[after, p] = x_new
        v[after, p] = v_new
        C[after, p] = C_new
        F_trial[kept, p] = F[now, p] + c.dt * (C_new * F[now, p])
        # Faults keep the first (step, particle); NaN first, because a NaN position is no longer comparable.
        here = wp.int64(step) * wp.int64(2147483648) + wp.int64(p)
        if not (wp.isfinite(v_new) and wp.isfinite(C_new)):
            wp.atomic_min(faults, 0, here)
        elif c.dt * wp.max(wp.abs(v_new)) > c.dx:
            wp.atomic_min(faults, 1, here)

    @kernel
    def trial_deformation(
        c: GridConstants,
        now: wp.int32,
        after: wp.int32,
        kept: wp.int32,
        C: wp.array2d(dtype=mat33),
        F: wp.array2d(dtype=mat33),
        F_trial: wp.array2d(dtype=mat33),
    ):
        """F_trial = (I + dt C) F, exactly as in g2p, for a reverse loop that kept only the states."""
        p = wp.tid()
        F_trial[kept, p] = F[now, p] + c.dt * (C[after, p] * F[now, p])

    @kernel
    def advect_tracers(
        c: GridConstants, kept: wp.int32, grid_v: wp.array2d(dtype=vec4), x: wp.array(dtype=vec3)
    ):
        """x += dt v with v interpolated over the nodes that carry mass; a tracer that sees none of them stays."""
        p = wp.tid()
        xp = x[p]
        bi = base_node(c, xp[0])
        bj = base_node(c, xp[1])
        bk = base_node(c, xp[2])
        w = weights(xp * c.inv_dx - vec3(real(bi), real(bj), real(bk)))
        total = vec4()
        for i in range(3):
            for j in range(3):
                row = ((bi + i) * c.n + bj + j) * c.n + bk
                for k in range(3):
                    total += (w[i, 0] * w[j, 1] * w[k, 2]) * grid_v[kept, row + k]
        if total[3] > real(0.0):
            v = vec3(total[0], total[1], total[2]) / total[3]
            x[p] = moved(c, xp, v)

    return SimpleNamespace(
        p2g=p2g, grid_update=grid_update, g2p=g2p, trial_deformation=trial_deformation, advect_tracers=advect_tracers
    )
