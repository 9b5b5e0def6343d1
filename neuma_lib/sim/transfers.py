"""Transfers on a CPU: each kernel is one thread that loops over all particles or nodes in vector code.

``transfers.h`` has the loops. They compute what `kernels` and `adjoint_kernels` do, with three differences:

- Nodes that no particle touches are neither cleared nor updated. ``spans`` (copies, 6, nodes^2) has the first and last
  in each row of the grid.
- Of earlier steps only these nodes are kept, one after the other, if they are not more than the particles. Else the
  reverse loop computes them again.
- Contact and clamps are passes over the particles before and after the loops, with the functions of other devices.
  Clamped particles have no mass in ``mass_now``.
"""

import functools
from types import SimpleNamespace

import torch
import warp as wp

from neuma_lib.device import native_source, start_warp
from neuma_lib.mechanics.singular_values_kernels import MATRICES
from neuma_lib.sim.adjoint_kernels import adjoint_functions
from neuma_lib.sim.body_contact import body_functions
from neuma_lib.sim.clamp_kernels import clamp_functions
from neuma_lib.sim.contact_kernels import contact_functions
from neuma_lib.sim.kernels import NO_CONTACT, forward_functions, grid_functions
from neuma_lib.sim.warp_types import typed, warp_types

start_warp()

_TEXT = native_source(__file__, ".h")
_TEXT["lanes"] = MATRICES + _TEXT["lanes"]


def _native(dtype: torch.dtype, *parts: str, held: bool = False) -> str:
    """C++ source of a loop from its parts."""
    text = "".join(_TEXT[part] for part in ("start", *parts, "end"))
    return text.replace("REAL", {torch.float32: "float", torch.float64: "double"}[dtype]).replace(
        "HELD", str(int(held))
    )


@functools.cache
def transfer_kernels(dtype: torch.dtype, features: tuple[str, ...] = ()) -> SimpleNamespace:
    """Kernels of the forward and of the reverse loop for a precision and features of the model (`forward_kernels`),
    "walls" included, of which a node has a boundary condition, or several bodies."""
    contact, clamps, bodies = "contact" in features, "clamps" in features, "bodies" in features
    special_nodes = clamps or "walls" in features
    held, prescribed = vars(clamp_functions(dtype)).values()
    touching = contact_functions(dtype, features)
    touch, touch_adjoint = touching.contact, touching.contact_adjoint
    t, functions = warp_types(dtype), grid_functions(dtype)
    real, vec3, vec4, mat33, GridConstants = t.real, t.vec3, t.vec4, t.mat33, t.GridConstants
    obstacle_row = functions.obstacle_row
    forward, adjoint = forward_functions(dtype, clamps, False), adjoint_functions(dtype, clamps, bodies)
    exchange = body_functions(dtype, GridConstants).exchange if bodies else None
    hold_mass, update_node, move_particle = forward.hold_mass, forward.update_node, forward.move_particle
    node_adjoint, deformation_adjoint = adjoint.node_adjoint, adjoint.deformation_adjoint
    moved_mask = functions.moved_mask
    module = f"neuma_lib.sim.transfers_{str(dtype).removeprefix('torch.')}_{'_'.join(features)}"
    kernel, row = typed(dtype, 2).kernel(module), typed(dtype, 1)

    @row.func_native(_native(dtype, "lanes", "block", "spans", "keep", "momentum", "p2g"))
    def p2g_loop(c, x, v, C, tau, mass, vol0, spans, grid: wp.array2d(dtype=vec4), kept, kept_spans): ...

    @row.func_native(_native(dtype, "spans", "keep", "restore"))
    def restore_nodes(c, spans, grid: wp.array2d(dtype=vec4), kept, kept_spans) -> wp.int32: ...

    @row.func_native(_native(dtype, "grid_update"))
    def grid_loop(c, spans, grid, grid_v): ...

    @row.func_native(_native(dtype, "lanes", "block", "g2p", held=clamps))
    def g2p_loop(c, step, mass, grid_v, x, F, x_after, v_after, C_after, F_trial, faults): ...

    @row.func_native(_native(dtype, "lanes", "block", "advect"))
    def advect_loop(c, grid_v, first_of, x): ...

    @row.func_native(_native(dtype, "lanes", "trial"))
    def trial_loop(c, C_after, F, F_trial): ...

    @row.func_native(_native(dtype, "lanes", "block", "g2p_adjoint", held=clamps))
    def g2p_adjoint_loop(
        c, mass, grid_v, x, F, x_after, v_after, C_after, grad_v, grad_C, grad_F_trial, grad_x, grad_F,
        grad_grid,
    ): ...  # fmt: skip

    @row.func_native(_native(dtype, "grid_adjoint"))
    def grid_adjoint_loop(c, spans, grid, grad_grid): ...

    @row.func_native(_native(dtype, "lanes", "block", "momentum", "p2g_adjoint"))
    def p2g_adjoint_loop(c, x, v, C, tau, mass, vol0, grad_grid, grad_x, grad_v, grad_C, grad_tau): ...

    @kernel
    def hold(
        c, now, pose, x, mass, vol0, radius, holds, clamp, mass_now, vol_now, radius_now, held_mass, held_by
    ):
        """Mass, volume and radius of particles as the grid and colliders see them, and the mass of held ones."""
        p = wp.tid()
        mass_now[p] = mass[p]
        vol_now[p] = vol0[p]
        radius_now[p] = radius[p]
        if held(holds, pose, clamp[p]):
            hold_mass(c, p, x[now, p], mass[p], clamp[p], held_mass, held_by)
            mass_now[p] = real(0.0)
            vol_now[p] = real(0.0)
            radius_now[p] = real(wp.static(NO_CONTACT))

    @row.func_native(_native(dtype, "lanes", "near"))
    def near_obstacles(c, others, again, x, v, radius, v_now, stuck, near) -> wp.int32: ...

    @row.func_native(_native(dtype, "far"))
    def clear_far(c, near, count, grad_stuck): ...

    @kernel
    def touch_obstacles(
        c, now, after, pose, again, x, v, radius_now, obstacles, distances, stuck, v_now, near, touching
    ):
        """Velocities of the particles after contact with obstacles, if one touches.

        Sets the particles that touch one, ``near[: touching[0]]``, in increasing order.
        """
        count = near_obstacles(
            c, obstacles.shape[1] - c.faces, again, x[now], v[now], radius_now, v_now, stuck[after], near
        )
        number = wp.int32(0)
        for q in range(count):
            p = near[q]
            v_p, stuck_p, touches = touch(
                obstacles, distances, obstacle_row(c, p, pose), c.faces, c.dt, x[now, p], v[now, p], stuck[now, p],
                radius_now[p],
            )  # fmt: skip
            if touches > 0:
                v_now[p] = v_p
                stuck[after, p] = stuck_p
                near[number] = p
                number += 1
        touching[0] = number

    @kernel
    def p2g(
        c, now, stressed, cached, again, x, v, C, tau, mass_now, vol_now, v_now, touching, spans, grids,
        kept, kept_spans,
    ):  # fmt: skip
        """As `kernels.p2g`, and clears all grids before. ``again``: from the nodes that the first time has kept, if it
        has."""
        if again == 1:
            if restore_nodes(c, spans, grids, kept[cached], kept_spans[cached]) == 1:
                return
        v_p = v[now]
        if wp.static(contact):
            if touching[0] > 0:
                v_p = v_now
        p2g_loop(
            c, x[now], v_p, C[now], tau[stressed], mass_now, vol_now, spans, grids, kept[cached], kept_spans[cached]
        )  # fmt: skip

    @kernel
    def grid_update(c, pose, spans, grids, holds, held_mass, held_by, pairs):
        """As `kernels.grid_update`, for the nodes of the spans."""
        if wp.static(special_nodes):
            lines = c.n * c.n
            for row in range(c.fields * lines):
                span = (row / lines * 6 + 4) * lines + row % lines
                for node in range(row * c.n + spans[span], row * c.n + spans[span + lines] + 1):
                    update_node(c, pose, node, grids[0], grids[1], holds, held_mass, held_by, pairs)
                    if wp.static(clamps):  # for the next step
                        held_mass[node] = real(0.0)
                        held_by[node] = 0
        else:
            grid_loop(c, spans, grids[0], grids[1])
        if wp.static(bodies):
            lines = c.n * c.n
            for row in range(c.fields * lines):
                span, body = (row / lines * 6 + 4) * lines + row % lines, row / lines % c.bodies
                for later in range(1, c.bodies - body):  # where both have nodes
                    theirs, away = span + 6 * later * lines, later * lines * c.n
                    low = wp.max(spans[span], spans[theirs])
                    high = wp.min(spans[span + lines], spans[theirs + lines])
                    for node in range(row * c.n + low, row * c.n + high + 1):
                        exchange(c, pairs, grids[0], grids[1], node, node + away)

    @kernel
    def g2p(c, now, after, cached, step, grids, mass_now, x, v, C, F, F_trial, faults):
        """As `kernels.g2p`, for particles that are not clamped."""
        g2p_loop(
            c, step, mass_now, grids[1], x[now], F[now], x[after], v[after], C[after], F_trial[cached], faults
        )

    @kernel
    def advect_tracers(c, grids, first_of, x: wp.array(dtype=vec3)):
        """As `kernels.advect_tracers`."""
        advect_loop(c, grids[1], first_of, x)

    @kernel
    def trial_deformation(c, now, after, cached, C, F, F_trial):
        """As `kernels.trial_deformation`, with the same bytes as g2p."""
        trial_loop(c, C[after], F[now], F_trial[cached])

    @kernel
    def move_held(c, now, after, cached, step, pose, x, v, C, F, F_trial, holds, clamp, faults):
        """As `kernels.g2p`, for clamped particles."""
        p = wp.tid()
        if held(holds, pose, clamp[p]):
            v_p = prescribed(holds[pose, clamp[p]], x[now, p])
            C_p = holds[pose, clamp[p]].A
            move_particle(c, now, after, cached, step, p, v_p, C_p, x, v, C, F, F_trial, faults)

    @kernel
    def g2p_adjoint(c, now, after, grids, mass_now, x, v, C, F, grad_v, grad_C, grad_F_trial, grad_x, grad_F):
        """As `adjoint_kernels.g2p_adjoint`, for particles that are not clamped."""
        g2p_adjoint_loop(
            c, mass_now, grids[1], x[now], F[now], x[after], v[after], C[after], grad_v, grad_C, grad_F_trial,
            grad_x, grad_F, grids[2],
        )  # fmt: skip

    @kernel
    def held_adjoint(c, after, pose, x, C, grad_v, grad_F_trial, grad_x, grad_F, holds, clamp):
        """As `adjoint_kernels.g2p_adjoint`, for clamped particles."""
        p = wp.tid()
        if held(holds, pose, clamp[p]):
            grad_F[p] = deformation_adjoint(c, C[after, p], grad_F_trial[p])
            g_x = wp.cw_mul(moved_mask(c, x[after, p]), grad_x[p])
            grad_x[p] = g_x + wp.transpose(holds[pose, clamp[p]].A) * (grad_v[p] + c.dt * g_x)

    @kernel
    def grid_adjoint(c, spans, grids, grad_before, grad_around):
        """As `adjoint_kernels.grid_adjoint`, for the nodes of the spans."""
        if wp.static(special_nodes or bodies):
            lines = c.n * c.n
            for row in range(c.fields * lines):
                span = (row / lines * 6 + 4) * lines + row % lines
                for node in range(row * c.n + spans[span], row * c.n + spans[span + lines] + 1):
                    node_adjoint(c, node, grids[0], grids[2], grad_before, grad_around)
        else:
            grid_adjoint_loop(c, spans, grids[0], grids[2])

    @kernel
    def p2g_adjoint(
        c, now, stressed, x, v, C, tau, mass_now, vol_now, v_now, touching, grids, grad_x, grad_v, grad_C,
        grad_tau,
    ):  # fmt: skip
        """As `adjoint_kernels.p2g_adjoint` without contact: grad_v is that of the velocity after it."""
        v_p = v[now]
        if wp.static(contact):
            if touching[0] > 0:
                v_p = v_now
        p2g_adjoint_loop(
            c, x[now], v_p, C[now], tau[stressed], mass_now, vol_now, grids[2], grad_x, grad_v, grad_C, grad_tau
        )  # fmt: skip

    @kernel
    def touch_adjoint_kernel(
        c, now, pose, x, v, radius_now, obstacles, distances, stuck, near, touching, grad_x, grad_v,
        grad_stuck,
    ):  # fmt: skip
        """From gradients of velocity and displacement after contact to those of x (added), v and stuck (set)."""
        for q in range(touching[0]):
            p = near[q]
            g_x, g_v, g_s = touch_adjoint(
                obstacles, distances, obstacle_row(c, p, pose), c.faces, c.dt, x[now, p], v[now, p],
                stuck[now, p], radius_now[p], grad_v[p], grad_stuck[p],
            )  # fmt: skip
            grad_x[p] = grad_x[p] + g_x
            grad_v[p] = g_v
            grad_stuck[p] = g_s
        clear_far(c, near, touching[0], grad_stuck)

    @row.func_native(
        """
    for (int k = 0; k < 9 * added.shape[0]; ++k) ((REAL*)total.data)[k] += ((const REAL*)added.data)[k];
    """.replace("REAL", {torch.float32: "float", torch.float64: "double"}[dtype])
    )
    def add_loop(added: wp.array(dtype=mat33), total: wp.array(dtype=mat33)): ...

    @kernel
    def add(c, grad_F_elastic, grad_F):
        add_loop(grad_F_elastic, grad_F)

    body_contact_adjoint = None
    if bodies:
        contact_adjoint = body_functions(dtype, GridConstants).adjoint

        @kernel
        def body_contact_adjoint(c, spans, grids, pairs, grad_before, grad_around):
            """As `adjoint_kernels.body_contact_adjoint`, for the nodes of the spans."""
            lines = c.n * c.n
            for row in range(c.fields * lines):
                span = (row / lines * 6 + 4) * lines + row % lines
                for node in range(row * c.n + spans[span], row * c.n + spans[span + lines] + 1):
                    contact_adjoint(c, pairs, grids[0], grids[2], node, grad_before, grad_around)

    return SimpleNamespace(
        add=add,
        body_contact_adjoint=body_contact_adjoint,
        hold=hold,
        touch=touch_obstacles,
        p2g=p2g,
        grid_update=grid_update,
        g2p=g2p,
        advect_tracers=advect_tracers,
        trial_deformation=trial_deformation,
        move_held=move_held,
        g2p_adjoint=g2p_adjoint,
        held_adjoint=held_adjoint,
        grid_adjoint=grid_adjoint,
        p2g_adjoint=p2g_adjoint,
        touch_adjoint=touch_adjoint_kernel,
    )
