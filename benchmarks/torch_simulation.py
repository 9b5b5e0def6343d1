"""The simulator in plain torch, differentiated by autograd: what speed and, in the tests, values are compared with."""

import torch

from neuma_lib.mechanics.catalogue import viscous_branch
from neuma_lib.sim.clamps import HELD_SHARE, clamped_particles
from neuma_lib.sim.colliders import CONTACT_STIFFNESS, contact_radius
from neuma_lib.sim.model import as_regions


def step(model, bodies, x, v, F, C, stuck, mass, vol0, time=0.0, clamp=None, over=0.0):
    """One step of the paper's Algorithm 2 with all 27 nodes of a particle as one axis.

    Args:
        stuck: tangential displacements of particles in contact [m], shape (N, 3).
        time: of the step [s], for moving colliders and clamps.
        clamp: index of the clamp of each particle, or -1, shape (N,).
        over: Kirchhoff stress of viscous branches [Pa], shape (N, 3, 3).
    """
    n, dx, dt = model.nodes, model.dx, model.dt
    tau = evaluate(bodies, "elasticity", F) + over
    clamp = torch.full_like(mass, -1) if clamp is None else clamp
    held = [(each, clamp == k) for k, each in enumerate(model.clamps) if each.holds(time, dt)]
    free = ~sum((mine for _, mine in held), start=torch.zeros_like(mass, dtype=torch.bool))
    free_v, free_stuck = contact(model, x[free], v[free], stuck[free], vol0[free], time)
    v, stuck = v.index_put((free,), free_v), torch.zeros_like(stuck).index_put((free,), free_stuck)
    all_mass, mass, vol0 = mass, free * mass, free * vol0
    cells = x / dx - model.first_node
    base = (cells.detach() - 0.5).int()
    f = cells - base
    w = torch.stack([0.5 * (1.5 - f) ** 2, 0.75 - (f - 1) ** 2, 0.5 * (f - 0.5) ** 2], dim=1)
    ticks = torch.arange(3)
    offset = torch.cartesian_prod(ticks, ticks, ticks).to(x.device)
    i, j, k = offset.unbind(1)
    weight = w[:, i, 0] * w[:, j, 1] * w[:, k, 2]
    d = (offset - f[:, None]) * dx
    node = base[:, None] + offset
    flat = (node[..., 0] * n + node[..., 1]) * n + node[..., 2]

    A = mass[:, None, None] * C - (4 * dt / dx**2) * vol0[:, None, None] * tau
    q = (mass[:, None] * v)[:, None] + torch.einsum("pab,pib->pia", A, d)
    m = x.new_zeros(n**3).index_add(0, flat.flatten(), (weight * mass[:, None]).flatten())
    mv = x.new_zeros(n**3, 3).index_add(0, flat.flatten(), (weight[..., None] * q).flatten(0, 1))

    gravity = x.new_tensor(model.gravity)
    grid_v = torch.where(m[:, None] > 0, mv / m.clamp(min=1e-300)[:, None] + dt * gravity, 0.0)
    grid_v = walls(model, grid_v.reshape(n, n, n, 3)).reshape(-1, 3)
    nodes = torch.cartesian_prod(*[torch.arange(n)] * 3).to(x) * dx + model.first_node * dx
    held_mass = [
        m.new_zeros(n**3).index_add(0, flat[mine].flatten(), (weight * all_mass[:, None])[mine].flatten())
        for _, mine in held
    ]
    for (each, _), own in zip(held, held_mass, strict=True):
        holds = (own > 0) & (sum(held_mass) > HELD_SHARE * (sum(held_mass) + m))
        grid_v = torch.where(holds[:, None], rigid_velocity(each, nodes, time, dt)[0], grid_v)

    v = torch.einsum("pi,pia->pa", weight, grid_v[flat])
    C = (4 / dx**2) * torch.einsum("pi,pia,pib->pab", weight, grid_v[flat], d)
    for each, mine in held:
        own_v, own_C = rigid_velocity(each, x, time, dt)
        v, C = torch.where(mine[:, None], own_v, v), torch.where(mine[:, None, None], own_C, C)
    x = x + dt * v
    if model.bounds_positions:
        x = x.clamp(*model.stencil_range)
    F = evaluate(bodies, "plasticity", F + dt * C @ F)
    return x, v, F, C, stuck


def contact(model, x, v, stuck, vol0, time):
    """Velocities after contact with all colliders, and tangential displacements, see `Collider`."""
    touches = torch.zeros_like(x[:, 0], dtype=torch.bool)
    for collider in model.obstacles:
        v, stuck, here = touched(collider, x, v, stuck, contact_radius(vol0), model.dt, time)
        touches = touches | here
    return v, torch.where(touches[:, None], stuck, 0.0)


def touched(collider, x, v, stuck, radius, dt, time):
    """The same of one collider, and which particles touch it."""
    distance, n = collider.surface(x, time)
    u, gap = collider.velocity_at(x, time), distance - radius
    impulse = -CONTACT_STIFFNESS * gap / dt - collider.damping * (n * (v - u)).sum(1)
    touches = ((gap < 0) & (impulse > 0))[:, None]

    def tangential(a):
        return a - (n * a).sum(1, keepdim=True) * n

    slip, sticking = tangential(v - u), tangential(stuck)
    friction = slip + CONTACT_STIFFNESS / dt * sticking
    limit = (min(collider.friction, 1e12) * impulse)[:, None]
    force = torch.where(touches, friction, 1.0).norm(dim=1, keepdim=True)
    slides = force > limit
    limited = torch.where(slides, limit / force * friction, friction)
    moved = torch.where(slides, limited * dt / CONTACT_STIFFNESS, sticking + dt * slip)
    after = v + impulse[:, None] * n - limited
    return torch.where(touches, after, v), torch.where(touches, moved, stuck), touches[:, 0]


def rigid_velocity(motion, x, time, dt):
    """Velocities (..., 3) with which points x (..., 3) of a moving frame reach their next place, and the gradient."""
    (axes, centre), (next_axes, next_centre) = (
        tuple(p.to(x) for p in motion.pose(t)) for t in (time, time + dt)
    )
    turn = next_axes @ axes.mT
    return (next_centre + (x - centre) @ turn.mT - x) / dt, (turn - torch.eye(3).to(x)) / dt


def walls(model, grid_v):
    """Conditions on the wall nodes of a grid of velocities (n, n, n, 3), one wall after the other."""
    n, thickness = model.nodes, model.wall_nodes
    for wall, condition in enumerate(model.boundary):
        axis, upper = divmod(wall, 2)
        index = torch.arange(n, device=grid_v.device)
        inside = (index >= n - thickness) if upper else (index < thickness)
        shape = [1, 1, 1]
        shape[axis] = n
        inside = inside.reshape(shape).expand(n, n, n)
        into = (grid_v[..., axis] > 0) if upper else (grid_v[..., axis] < 0)
        if condition == "sticky":
            stopped = inside[..., None].expand_as(grid_v)
        elif condition == "no_slip":
            stopped = (inside & into)[..., None].expand_as(grid_v)
        else:
            stopped = torch.zeros_like(grid_v, dtype=torch.bool)
            stopped[..., axis] = inside & into
        grid_v = torch.where(stopped, 0.0, grid_v)
    return grid_v


def evaluate(bodies, part, F):
    """Elasticity or plasticity of every body."""
    return torch.cat([getattr(body.law, part)(F[body.start : body.stop]) for body in bodies])


def branch(bodies, F):
    """Logarithmic strains (N, 3) of the viscous branches without their mean, their axes (N, 3, 3), and the shear moduli
    and relaxation times of their laws (N, 1)."""
    values, axes = torch.linalg.eigh(F @ F.mT)
    log = 0.5 * values.log()
    constants = [
        viscous_branch(body.law.viscosity.values) for body in bodies for _ in range(body.start, body.stop)
    ]
    G, T = (torch.stack([torch.as_tensor(c[k], dtype=F.dtype) for c in constants])[:, None] for k in (0, 1))
    return log - log.mean(1, keepdim=True), axes, G, T


def overstress(bodies, F):
    """Kirchhoff stress 2 G dev eps of the branches (N, 3, 3)."""
    strain, axes, G, _ = branch(bodies, F)
    return axes @ torch.diag_embed(2 * G * strain) @ axes.mT


def relaxed(bodies, F, dt):
    """F (N, 3, 3) of the branches after an implicit step of the relaxation of their strain."""
    strain, axes, _, T = branch(bodies, F)
    return axes @ torch.diag_embed((strain / (1 + dt / T) - strain).exp()) @ axes.mT @ F


def rollout(model, law, state, frames, total=False):
    """States (x, v, F, C) of a `State` at the frames, with the total deformation after them if asked for.

    Each has the shape (T, N, ...). With a viscous part of all laws, the state has an F_branch.
    """
    bodies = as_regions(law, len(state.x))
    now, stuck, seen = state.motion, torch.zeros_like(state.x), []
    F_total = (state.F,) if total else ()
    clamp = clamped_particles(model.clamps, state.x) if state.clamp is None else state.clamp
    viscous, F_branch, over = bodies[0].law.viscosity is not None, state.F_branch, 0.0
    for n in range(frames[-1] + 1):
        if n in frames:
            seen.append((*now, *F_total))
        if n < frames[-1]:
            if viscous:
                over = overstress(bodies, F_branch)
            *now, stuck = step(model, bodies, *now, stuck, state.mass, state.vol0, n * model.dt, clamp, over)
            if viscous:
                F_branch = relaxed(bodies, F_branch + model.dt * now[3] @ F_branch, model.dt)
            F_total = tuple(F + model.dt * now[3] @ F for F in F_total)
    return tuple(torch.stack(values) for values in zip(*seen, strict=True))
