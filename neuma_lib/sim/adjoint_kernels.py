"""Hand-written adjoints of the transfers in `kernels`, run in reverse order.

``grad_y`` is the derivative of the loss with respect to ``y``. The adjoint of a gather is a scatter over the same
stencil and vice versa, so `g2p_adjoint` reads like P2G and `p2g_adjoint` like G2P. The derivative of a weight by the
position is dw_i/dx = N'_i / dx, that of an offset d_i = x_i - x is -I.
"""

import functools
from types import SimpleNamespace

import torch
import warp as wp

from neuma_lib.sim.body_contact import body_functions
from neuma_lib.sim.clamp_kernels import clamp_functions
from neuma_lib.sim.contact_kernels import contact_functions
from neuma_lib.sim.gather import gather_functions
from neuma_lib.sim.kernels import NO_CONTACT, grid_functions
from neuma_lib.sim.scatter import scatter_functions
from neuma_lib.sim.warp_types import typed, warp_types


@functools.cache
def adjoint_functions(dtype: torch.dtype, clamps: bool, bodies: bool) -> SimpleNamespace:
    """Adjoints of `kernels.forward_functions`."""
    t, wall_mask = warp_types(dtype), grid_functions(dtype).wall_mask
    real, vec3, vec4, mat33, GridConstants = t.real, t.vec3, t.vec4, t.mat33, t.GridConstants
    mass_gradient = body_functions(dtype, GridConstants).mass_gradient if bodies else None
    row = typed(dtype, 1)

    @wp.func
    def deformation_adjoint(c: GridConstants, C_after: mat33, grad_F_trial: mat33):
        """Gradient of F from F_trial = (I + dt C) F."""
        return grad_F_trial + c.dt * (wp.transpose(C_after) * grad_F_trial)

    @row.func
    def node_adjoint(c, node, grid, grad_grid, grad_before, grad_around):
        """In place: from the gradient of a node's velocity to those of its momentum and mass.

        With several bodies the gradient of the velocity before contact is in ``grad_before`` (`body_contact`).
        """
        mv = grid[node]
        if mv[3] > real(0.0):
            v = vec3(mv[0], mv[1], mv[2]) / mv[3]
            g = grad_grid[node]
            if wp.static(bodies):
                g = grad_before[node]
            g_mv = wp.cw_mul(vec3(g[0], g[1], g[2]), wall_mask(c, node, v + c.dt * c.gravity)) / mv[3]
            g_m = -wp.dot(g_mv, v)
            if wp.static(bodies):
                g_m += mass_gradient(c, node, grad_before, grad_around)
            grad_grid[node] = vec4(g_mv[0], g_mv[1], g_mv[2], g_m)
        if wp.static(clamps):
            if mv[3] < real(0.0):  # a held node
                grad_grid[node] = vec4()

    return SimpleNamespace(deformation_adjoint=deformation_adjoint, node_adjoint=node_adjoint)


@functools.cache
def adjoint_kernels(
    dtype: torch.dtype, scatter: str = "atomic", features: tuple[str, ...] = ()
) -> SimpleNamespace:
    """Kernels `g2p_adjoint`, `grid_adjoint` and `p2g_adjoint`, and `body_contact_adjoint` if there are several bodies.

    See `kernels.forward_kernels`.
    """
    contact, clamps, bodies = "contact" in features, "clamps" in features, "bodies" in features
    held = clamp_functions(dtype).held
    t, functions = warp_types(dtype), grid_functions(dtype)
    touching = contact_functions(dtype, features)
    touch, touch_adjoint = touching.contact, touching.contact_adjoint
    ordered = scatter != "atomic"
    run_of, deposit = scatter_functions(dtype, scatter, 3)
    real, vec3, vec4, mat33 = t.real, t.vec3, t.vec4, t.mat33
    stencil, slopes, moments = functions.stencil, functions.slopes, functions.moments
    column, moved_mask, obstacle_row = functions.column, functions.moved_mask, functions.obstacle_row
    deformation_adjoint, node_adjoint = vars(adjoint_functions(dtype, clamps, bodies)).values()
    gather, three_nodes = gather_functions(dtype)
    module = f"neuma_lib.sim.adjoint_{str(dtype).removeprefix('torch.')}_{'_'.join((scatter, *features))}"
    kernel = typed(dtype, 2).kernel(module)

    @kernel
    def g2p_adjoint(
        c, now, after, cached, side, sort, pose, order, x, v, C, F, grid_v_rows, grad_v, grad_C,
        grad_F_trial, grad_x, grad_F, holds, clamp, grad_grid_rows,
    ):  # fmt: skip
        """From gradients of x, v, C after the step and of F_trial to those of grid_v (added), x and F (set)."""
        p = wp.tid()
        alive = p < grad_x.shape[0]
        if wp.static(ordered):
            p = order[sort, wp.min(p, grad_x.shape[0] - 1)]
        first, f, wi, wj, wk = stencil(c, p, x[now, p])
        run = run_of(wp.where(alive, first, -1))
        si, sj, sk = slopes(f[0]), slopes(f[1]), slopes(f[2])
        # gradients of C, F and v from F_trial = (I + dt C) F and x = x + dt v
        g_trial = grad_F_trial[p]
        if alive:
            grad_F[p] = deformation_adjoint(c, C[after, p], g_trial)
        g_C = grad_C[p] + c.dt * (g_trial * wp.transpose(F[now, p]))
        g_x = wp.cw_mul(moved_mask(c, x[after, p]), grad_x[p])
        g_v = grad_v[p] + c.dt * g_x
        if wp.static(clamps):
            if held(holds, pose, clamp[p]):  # v = A (x - centre) + velocity, and no node moves with v or C
                g_x = g_x + wp.transpose(holds[pose, clamp[p]].A) * g_v
                g_v = vec3()
                g_C = mat33()
        # Node i receives w_i u_i with u_i = g_v + D d_i / dx. u grows by a column of D from node to node.
        D = (real(4.0) * c.inv_dx) * g_C
        u0 = g_v - D * f
        u_i = vec4(u0[0], u0[1], u0[2], real(0.0))
        step_k = vec3(real(0.0), real(1.0), real(2.0))
        slope_k = wp.outer(wp.cw_mul(wk, step_k), column(D, 2))
        moving = vec3()  # sum (v_i . u_i) N'_i
        for i in range(3):
            u_ij = u_i
            for j in range(3):
                row = first + (i * c.n + j) * c.n
                deposit(grad_grid_rows, side, row, (wi[i] * wj[j]) * (wp.outer(wk, u_ij) + slope_k), run)
                nodes = three_nodes(grid_v_rows, cached, row)
                vu = nodes * u_ij + wp.cw_mul(step_k, nodes * column(D, 2))
                vu_w, vu_s = wp.dot(vu, wk), wp.dot(vu, sk)
                moving += vec3(si[i] * wj[j] * vu_w, wi[i] * sj[j] * vu_w, wi[i] * wj[j] * vu_s)
                u_ij += column(D, 1)
            u_i += column(D, 0)
        if alive:
            grad_x[p] = g_x + c.inv_dx * (moving - wp.transpose(D) * v[after, p])

    @kernel
    def grid_adjoint(c, cached, side, grid, grad_grid, grad_before, grad_around):
        """Gradients of the nodes in place (`adjoint_functions`).

        Clears the other side of `grad_grid` for the previous step.
        """
        node = wp.tid()
        node_adjoint(c, node, grid[cached], grad_grid[side], grad_before, grad_around)
        grad_grid[1 - side, node] = vec4()

    @kernel
    def p2g_adjoint(
        c, now, cached, side, pose, x, v, C, tau, mass, vol0, radius, obstacles, distances, stuck, holds,
        clamp, grad_grid_rows, grad_x, grad_v, grad_C, grad_tau, grad_stuck,
    ):  # fmt: skip
        """From gradients of momentum and mass of the nodes to those of x (added), v, C and tau (set)."""
        p = wp.tid()
        first, f, wi, wj, wk = stencil(c, p, x[now, p])
        si, sj, sk = slopes(f[0]), slopes(f[1]), slopes(f[2])
        wd_i, wd_j, wd_k = moments(wi, f[0]), moments(wj, f[1]), moments(wk, f[2])
        # q_i = (m v + A d_i, m) as in p2g
        m = mass[p]
        vol = vol0[p]
        r = radius[p]
        if wp.static(clamps):
            if held(holds, pose, clamp[p]):
                m = real(0.0)
                vol = real(0.0)
                r = real(wp.static(NO_CONTACT))
        stress = real(4.0) * c.dt * c.inv_dx * c.inv_dx * vol
        A = c.dx * (m * C[now, p] - stress * tau[cached, p])
        v_p = v[now, p]
        if wp.static(contact):
            row_p = obstacle_row(c, p, pose)
            v_p, _stuck, touches = touch(
                obstacles, distances, row_p, c.faces, c.dt, x[now, p], v_p, stuck[now, p], r
            )
        q0 = m * v_p - A * f
        q_i = vec4(q0[0], q0[1], q0[2], m)
        step_k = vec3(real(0.0), real(1.0), real(2.0))
        # rows: sum w g, then the columns of G = sum w g d^T / dx
        S = gather(grad_grid_rows, side, first, c.n, wi, wj, wk, wd_i, wd_j, wd_k)
        moving = vec3()  # sum (g_i . q_i) N'_i
        for i in range(3):
            q_ij = q_i
            for j in range(3):
                nodes = three_nodes(grad_grid_rows, side, first + (i * c.n + j) * c.n)
                gq = nodes * q_ij + wp.cw_mul(step_k, nodes * column(A, 2))
                gq_w, gq_s = wp.dot(gq, wk), wp.dot(gq, sk)
                moving += vec3(si[i] * wj[j] * gq_w, wi[i] * sj[j] * gq_w, wi[i] * wj[j] * gq_s)
                q_ij += column(A, 1)
            q_i += column(A, 0)
        g = vec3(S[0, 0], S[0, 1], S[0, 2])
        g_A = c.dx * mat33(S[1, 0], S[2, 0], S[3, 0], S[1, 1], S[2, 1], S[3, 1], S[1, 2], S[2, 2], S[3, 2])
        g_v = m * g
        if wp.static(contact):
            g_s = vec3()
            if touches > 0:
                g_x, g_v_before, g_s = touch_adjoint(
                    obstacles,
                    distances,
                    row_p,
                    c.faces,
                    c.dt,
                    x[now, p],
                    v[now, p],
                    stuck[now, p],
                    r,
                    g_v,
                    grad_stuck[p],
                )
                grad_x[p] = grad_x[p] + g_x
                g_v = g_v_before
            grad_stuck[p] = g_s
        grad_v[p] = g_v
        grad_C[p] = m * g_A
        grad_tau[p] = -stress * g_A
        grad_x[p] = grad_x[p] + c.inv_dx * (moving - wp.transpose(A) * g)

    body_contact_adjoint = None
    if bodies:
        contact_adjoint = body_functions(dtype, t.GridConstants).adjoint

        @kernel
        def body_contact_adjoint(c, cached, side, grid, grad_grid, pairs, grad_before, grad_around):
            contact_adjoint(c, pairs, grid[cached], grad_grid[side], wp.tid(), grad_before, grad_around)

    return SimpleNamespace(
        g2p_adjoint=g2p_adjoint,
        body_contact_adjoint=body_contact_adjoint,
        grid_adjoint=grid_adjoint,
        p2g_adjoint=p2g_adjoint,
    )
