"""Transfers of the material point method as Warp kernels: particles to grid, grid update, grid to particles.

MLS-MPM (Hu et al. 2018) with quadratic B-splines and the affine velocity C of APIC (Jiang et al. 2015), in the order
and letters of the paper's Eq. 5 and Algorithm 2 (appendix "Introduction to the Material Point Method"). Adjoints are
in `adjoint_kernels`.

Memory: the first axis of an array is the step. ``now`` and ``after`` are the indices of the states before and after
the current step, ``cached`` that of its stress and grid (`Workspace`). A grid node is a 4-vector: momentum and mass
(``grid``), or velocity and 1 where there is mass (``grid_v``). The stencil of a particle has 3 x 3 rows of three
consecutive nodes, so kernels use ``rows``: a view of the grid whose element b is the matrix (3 x 4) of nodes b, b + 1
and b + 2. Sums over the last axis of the stencil are products with a row.

Order: for scatter methods that profit from neighbouring particles in a warp (`scatter`), thread i processes particle
``order[sort, i]``, from a sort by cell a few steps ago. Gathers are faster in the order of memory.

Copies: several independent simulations with equal numbers of particles are stored one after the other in the arrays
of particles and of nodes. Each body of a copy has its own nodes (`body_contact`).
"""

import functools
from types import SimpleNamespace

import torch
import warp as wp

from neuma_lib.device import start_warp
from neuma_lib.sim.body_contact import body_functions
from neuma_lib.sim.clamp_kernels import clamp_functions
from neuma_lib.sim.clamps import HELD_SHARE
from neuma_lib.sim.contact_kernels import contact_functions
from neuma_lib.sim.gather import gather_functions
from neuma_lib.sim.scatter import scatter_functions
from neuma_lib.sim.warp_types import typed, warp_types

start_warp()

NO_SLIP, SLIP, STICKY = 0, 1, 2  # codes of the boundary conditions in ``GridConstants.walls``

NO_FAULT = 2**62  # value of a fault flag without a fault

NO_CONTACT = -1e3  # radius [m] of clamped particles, which touch no collider


@functools.cache
def grid_functions(dtype: torch.dtype) -> SimpleNamespace:
    """Functions shared by the transfers and their adjoints: stencil, boundary condition, motion."""
    t = warp_types(dtype)
    real, vec3, vec4, mat33, GridConstants = t.real, t.vec3, t.vec4, t.mat33, t.GridConstants

    @wp.func
    def base_node(c: GridConstants, x: real):
        """First of the three nodes around coordinate x, clamped to valid indices."""
        return wp.clamp(wp.int32(x * c.inv_dx - (c.first + real(0.5))), 0, c.n - 3)

    @wp.func
    def copy_of(c: GridConstants, p: wp.int32):
        """Copy of particle p."""
        copy = wp.int32(0)
        if p >= c.particles:  # avoids the division for a single copy
            copy = p / c.particles
        return copy

    @wp.func
    def field_of(c: GridConstants, p: wp.int32):
        """Grid of particle p."""
        field = copy_of(c, p)
        if c.bodies > 1:
            q = p - field * c.particles
            field = field * c.bodies
            own = wp.int32(0)
            for k in range(1, c.ranges):
                if q >= c.starts[k]:
                    own = k
            field += c.body_of[own]
        return field

    @wp.func
    def obstacle_row(c: GridConstants, p: wp.int32, pose: wp.int32):
        """Row of the obstacles of particle p, which copies have with their own friction."""
        return pose * c.copies + copy_of(c, p)

    @wp.func
    def weights(f: real):
        """Quadratic B-spline N at the three nodes of an axis, at the distance f from the first [dx]."""
        return vec3(
            real(0.5) * (real(1.5) - f) * (real(1.5) - f),
            real(0.75) - (f - real(1.0)) * (f - real(1.0)),
            real(0.5) * (f - real(0.5)) * (f - real(0.5)),
        )

    @wp.func
    def slopes(f: real):
        """Derivatives of the weights with respect to f."""
        return vec3(f - real(1.5), real(2.0) - real(2.0) * f, f - real(0.5))

    @wp.func
    def stencil(c: GridConstants, p: wp.int32, x: vec3):
        """First of the 27 nodes of particle p at x, distance of x from it [dx], and weights along each axis."""
        i, j, k = base_node(c, x[0]), base_node(c, x[1]), base_node(c, x[2])
        f = x * c.inv_dx - vec3(real(i) + c.first, real(j) + c.first, real(k) + c.first)
        first = ((field_of(c, p) * c.n + i) * c.n + j) * c.n + k
        return first, f, weights(f[0]), weights(f[1]), weights(f[2])

    @wp.func
    def moments(w: vec3, f: real):
        """Products of the weights of an axis and the offsets of its nodes from the particle [dx]."""
        return wp.cw_mul(w, vec3(-f, real(1.0) - f, real(2.0) - f))

    @wp.func
    def column(A: mat33, a: wp.int32):
        """Column a of A, with 0 for the mass."""
        return vec4(A[0, a], A[1, a], A[2, a], real(0.0))

    @wp.func
    def wall_mask(c: GridConstants, node: wp.int32, v: vec3):
        """1 for each component of a node's velocity v that the walls admit, else 0."""
        mask = vec3(real(1.0), real(1.0), real(1.0))
        place = node
        for axis in range(3):
            a = 2 - axis  # the last axis runs fastest
            i = place % c.n
            place = place / c.n
            for side in range(2):
                inside = i < c.wall_nodes
                towards = v[a] < real(0.0)
                if side == 1:
                    inside = i >= c.n - c.wall_nodes
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
        """Position after a step, clamped for the walls of the released code."""
        return wp.max(wp.min(x + c.dt * v, vec3(c.clamp_high)), vec3(c.clamp_low))

    @wp.func
    def moved_mask(c: GridConstants, x_new: vec3):
        """Derivative of `moved` with respect to the unclamped position: 0 for components at a bound."""
        mask = vec3()
        for a in range(3):
            if x_new[a] > c.clamp_low and x_new[a] < c.clamp_high:
                mask[a] = real(1.0)
        return mask

    return SimpleNamespace(
        copy_of=copy_of,
        obstacle_row=obstacle_row,
        stencil=stencil,
        slopes=slopes,
        moments=moments,
        column=column,
        wall_mask=wall_mask,
        moved=moved,
        moved_mask=moved_mask,
    )


@functools.cache
def forward_functions(dtype: torch.dtype, clamps: bool, bodies: bool) -> SimpleNamespace:
    """Parts of the forward kernels that are the same on every device: for a held particle, a node, and a particle."""
    t, functions = warp_types(dtype), grid_functions(dtype)
    prescribed = clamp_functions(dtype).prescribed
    real, vec3, vec4, mat33 = t.real, t.vec3, t.vec4, t.mat33
    copy_of, stencil = functions.copy_of, functions.stencil
    wall_mask, moved = functions.wall_mask, functions.moved
    contact_change = body_functions(dtype, t.GridConstants).change if bodies else None
    row = typed(dtype, 1)

    @row.func
    def hold_mass(c, p, x: vec3, m: real, clamp: wp.int32, held_mass, held_by):
        """Add the mass of a clamped particle to the clamped mass of its nodes."""
        first, _, wi, wj, wk = stencil(c, p, x)
        for node in range(27):
            i, j, k = node / 9, node / 3 % 3, node % 3
            here = first + (i * c.n + j) * c.n + k
            wp.atomic_add(held_mass, here, wi[i] * wj[j] * wk[k] * m)
            wp.atomic_max(held_by, here, clamp)

    @row.func
    def update_node(c, pose, node, grid, grid_v, holds, held_mass, held_by, pairs):
        """v_i = (m v)_i / m_i + dt g where there is mass, then the boundary conditions and contact of bodies.

        Held nodes move with their clamp. Their mass becomes -1, so that `grid_adjoint` knows them.
        """
        mv = grid[node]
        result = vec4()
        if mv[3] > real(0.0):
            v = vec3(mv[0], mv[1], mv[2]) / mv[3] + c.dt * c.gravity
            v = wp.cw_mul(v, wall_mask(c, node, v))
            if wp.static(bodies):
                v += contact_change(c, pairs, grid, node)
            result = vec4(v[0], v[1], v[2], real(1.0))
        if wp.static(clamps):
            m = held_mass[node]
            if m > real(wp.static(HELD_SHARE)) * (m + mv[3]):
                place = vec3(real(node / (c.n * c.n) % c.n), real(node / c.n % c.n), real(node % c.n))
                u = prescribed(holds[pose, held_by[node]], c.dx * (place + vec3(c.first)))
                result = vec4(u[0], u[1], u[2], real(1.0))
                grid[node] = vec4(real(0.0), real(0.0), real(0.0), real(-1.0))
        grid_v[node] = result

    @typed(dtype, 2).func
    def move_particle(c, now, after, cached, step, p, v_new: vec3, C_new: mat33, x, v, C, F, F_trial, faults):
        """Set the state of a particle after the step, and flag its faults."""
        x_new = moved(c, x[now, p], v_new)
        x[after, p] = x_new
        v[after, p] = v_new
        C[after, p] = C_new
        F_trial[cached, p] = F[now, p] + c.dt * (C_new * F[now, p])
        # Faults keep the first (step, particle). Velocities are checked because clamping hides errors of positions.
        copy, here = copy_of(c, p), wp.int64(step) * wp.int64(2147483648) + wp.int64(p)
        if not (wp.isfinite(v_new) and wp.isfinite(C_new)):
            wp.atomic_min(faults, copy, 0, here)
        elif c.dt * wp.max(wp.abs(v_new)) > c.dx:
            wp.atomic_min(faults, copy, 1, here)
        elif wp.min(x_new) < c.leave_low or wp.max(x_new) > c.leave_high:
            wp.atomic_min(faults, copy, 2, here)

    return SimpleNamespace(hold_mass=hold_mass, update_node=update_node, move_particle=move_particle)


@functools.cache
def forward_kernels(
    dtype: torch.dtype, scatter: str = "atomic", features: tuple[str, ...] = ()
) -> SimpleNamespace:
    """Kernels `cells`, `p2g`, `grid_update` and `g2p` for a precision, a scatter method and features of the model:
    "contact" of particles, shapes other than planes that they touch, "clamps", and several "bodies"."""
    contact, clamps, bodies = "contact" in features, "clamps" in features, "bodies" in features
    held, prescribed = vars(clamp_functions(dtype)).values()
    t, functions = warp_types(dtype), grid_functions(dtype)
    touch = contact_functions(dtype, features).contact
    ordered = scatter != "atomic"
    run_of, deposit = scatter_functions(dtype, scatter, 4)
    real, vec3, vec4, mat33 = t.real, t.vec3, t.vec4, t.mat33
    stencil, moments, column = functions.stencil, functions.moments, functions.column
    obstacle_row = functions.obstacle_row
    hold_mass, update_node, move_particle = vars(forward_functions(dtype, clamps, bodies)).values()
    gather, _ = gather_functions(dtype)
    module = f"neuma_lib.sim.forward_{str(dtype).removeprefix('torch.')}_{'_'.join((scatter, *features))}"
    kernel = typed(dtype, 2).kernel(module)

    @kernel
    def cells(c, now, x, cell):
        """Index of the first node of a particle's stencil, as a sort key."""
        p = wp.tid()
        first, _, _, _, _ = stencil(c, p, x[now, p])
        cell[p] = first

    @kernel
    def p2g(
        c, now, cached, sort, pose, after, order, x, v, C, tau, mass, vol0, radius, obstacles, distances,
        stuck, holds, clamp, held_mass, held_by, grid_rows,
    ):  # fmt: skip
        """m_i += w_i m, (m v)_i += w_i (m v + A d_i) with A = m C - dt vol0 (4/dx^2) tau, d_i = x_i - x.

        v is the velocity after contact of particles. The mass of clamped particles goes to held_mass instead.
        """
        p = wp.tid()
        alive = p < mass.shape[0]
        if wp.static(ordered):
            p = order[sort, wp.min(p, mass.shape[0] - 1)]
        first, f, wi, wj, wk = stencil(c, p, x[now, p])
        run = run_of(wp.where(alive, first, -1))
        m = mass[p]
        vol = vol0[p]
        r = radius[p]
        if wp.static(clamps):
            if held(holds, pose, clamp[p]):
                if alive:
                    hold_mass(c, p, x[now, p], m, clamp[p], held_mass, held_by)
                m = real(0.0)
                vol = real(0.0)
                r = real(wp.static(NO_CONTACT))
        A = c.dx * (m * C[now, p] - (real(4.0) * c.dt * c.inv_dx * c.inv_dx * vol) * tau[cached, p])
        v_p = v[now, p]
        if wp.static(contact):
            row_p = obstacle_row(c, p, pose)
            v_p, stuck_p, _touches = touch(
                obstacles, distances, row_p, c.faces, c.dt, x[now, p], v_p, stuck[now, p], r
            )
            stuck[after, p] = stuck_p
        # q = (m v + A d, m) grows by a column of A from node to node
        q0 = m * v_p - A * f
        q_i = vec4(q0[0], q0[1], q0[2], m)
        slope_k = wp.outer(wp.cw_mul(wk, vec3(real(0.0), real(1.0), real(2.0))), column(A, 2))
        for i in range(3):
            q_ij = q_i
            for j in range(3):
                row = first + (i * c.n + j) * c.n
                deposit(grid_rows, cached, row, (wi[i] * wj[j]) * (wp.outer(wk, q_ij) + slope_k), run)
                q_ij += column(A, 1)
            q_i += column(A, 0)

    @kernel
    def grid_update(c, cached, pose, grid, grid_v, holds, held_mass, held_by, pairs):
        """Velocities of the nodes (`forward_functions`)."""
        update_node(c, pose, wp.tid(), grid[cached], grid_v[cached], holds, held_mass, held_by, pairs)

    @kernel
    def g2p(c, now, after, cached, step, pose, grid_v_rows, x, v, C, F, F_trial, holds, clamp, faults):
        """v = sum w_i v_i,  C = (4/dx^2) sum w_i v_i d_i^T,  x += dt v (bounded),  F_trial = (I + dt C) F.

        v and C of clamped particles are those of their clamp.
        """
        p = wp.tid()
        xp = x[now, p]
        first, f, wi, wj, wk = stencil(c, p, xp)
        wd_i, wd_j, wd_k = moments(wi, f[0]), moments(wj, f[1]), moments(wk, f[2])
        # rows: sum w v, then the columns of B = sum w v d^T / dx
        S = gather(grid_v_rows, cached, first, c.n, wi, wj, wk, wd_i, wd_j, wd_k)
        v_new = vec3(S[0, 0], S[0, 1], S[0, 2])
        C_new = (real(4.0) * c.inv_dx) * mat33(
            S[1, 0], S[2, 0], S[3, 0], S[1, 1], S[2, 1], S[3, 1], S[1, 2], S[2, 2], S[3, 2]
        )
        if wp.static(clamps):
            if held(holds, pose, clamp[p]):
                v_new = prescribed(holds[pose, clamp[p]], xp)
                C_new = holds[pose, clamp[p]].A
        move_particle(c, now, after, cached, step, p, v_new, C_new, x, v, C, F, F_trial, faults)

    return SimpleNamespace(cells=cells, p2g=p2g, grid_update=grid_update, g2p=g2p)


@functools.cache
def deformation_kernels(dtype: torch.dtype) -> SimpleNamespace:
    """Kernels `trial_deformation`, `total_adjoint`, `advect_tracers` and `add_gradients` for a precision."""
    t, functions = warp_types(dtype), grid_functions(dtype)
    real, vec3, vec4 = t.real, t.vec3, t.vec4
    stencil, moved = functions.stencil, functions.moved
    module = f"neuma_lib.sim.deformation_{str(dtype).removeprefix('torch.')}"
    kernel = typed(dtype, 2).kernel(module)

    @kernel
    def trial_deformation(c, now, after, cached, C, F, F_trial):
        """F_trial = (I + dt C) F, bit-identical to g2p, for a reverse loop that kept only the states.

        With the total deformation for F and F_trial, and `after` for `cached`, it advances the total deformation.
        """
        p = wp.tid()
        F_trial[cached, p] = F[now, p] + c.dt * (C[after, p] * F[now, p])

    @kernel
    def advect_tracers(c, cached, grid_v_rows, first_of, x: wp.array(dtype=vec3)):
        """x += dt v, interpolated over nodes with mass of a tracer's body in the first copy.

        ``first_of`` has the first particle of that body. A tracer without such nodes stays.
        """
        p = wp.tid()
        xp = x[p]
        first, _, wi, wj, wk = stencil(c, first_of[p], xp)
        total = vec4()
        for i in range(3):
            for j in range(3):
                total += (wi[i] * wj[j]) * (wk * grid_v_rows[cached, first + (i * c.n + j) * c.n])
        if total[3] > real(0.0):
            x[p] = moved(c, xp, vec3(total[0], total[1], total[2]) / total[3])

    @kernel
    def total_adjoint(c, now, after, C, F_total, grad_C, grad_F_total):
        """In place: from the gradient of F_total after the step to those of C (added) and of F_total before it."""
        p = wp.tid()
        g = grad_F_total[p]
        grad_C[p] = grad_C[p] + c.dt * (g * wp.transpose(F_total[now, p]))
        grad_F_total[p] = g + c.dt * (wp.transpose(C[after, p]) * g)

    @kernel
    def add_gradients(
        c, frame_of_x, frame_of_F, added_x: wp.array2d(dtype=real), added_F: wp.array2d(dtype=real),
        grad_F_elastic: wp.array(dtype=real), grad_x: wp.array(dtype=real), grad_F: wp.array(dtype=real),
    ):  # fmt: skip
        """Add the gradient of F from elasticity, and those of x and F at a frame unless its index is -1.

        A thread adds single numbers, so that neighbours in a warp access neighbours in memory.
        """
        k = wp.tid()
        total = grad_F[k] + grad_F_elastic[k]
        if frame_of_F >= 0:
            total = total + added_F[frame_of_F, k]
        grad_F[k] = total
        if frame_of_x >= 0 and k < grad_x.shape[0]:
            grad_x[k] = grad_x[k] + added_x[frame_of_x, k]

    return SimpleNamespace(
        add_gradients=add_gradients,
        trial_deformation=trial_deformation,
        total_adjoint=total_adjoint,
        advect_tracers=advect_tracers,
    )
