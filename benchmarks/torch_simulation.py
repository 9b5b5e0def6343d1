"""The simulator in plain torch, differentiated by autograd: what speed and, in the tests, values are compared with."""

import torch

from neuma_lib.mechanics.catalogue import viscous_branch
from neuma_lib.sim.body_contact import CERTAIN, CHOICE, COMMON, REACH
from neuma_lib.sim.clamps import HELD_SHARE, clamped_particles
from neuma_lib.sim.colliders import CONTACT_STIFFNESS, contact_radius
from neuma_lib.sim.model import as_regions


def step(model, regions, x, v, F, C, stuck, mass, vol0, time=0.0, clamp=None, over=0.0, bodies=()):
    """One step of the paper's Algorithm 2 with all 27 nodes of a particle as one axis.

    Args:
        stuck: tangential displacements of particles in contact [m], shape (N, 3).
        time: of the step [s], for moving colliders and clamps.
        clamp: index of the clamp of each particle, or -1, shape (N,).
        over: Kirchhoff stress of viscous branches [Pa], shape (N, 3, 3).
        bodies: number of particles of each body, if there are several.
    """
    n, dx, dt = model.nodes, model.dx, model.dt
    tau = evaluate(regions, "elasticity", F) + over
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
    count = max(1, len(bodies))
    body = torch.arange(count).repeat_interleave(torch.tensor(bodies or (len(x),))).to(x.device)
    flat = ((body[:, None] * n + node[..., 0]) * n + node[..., 1]) * n + node[..., 2]

    A = mass[:, None, None] * C - (4 * dt / dx**2) * vol0[:, None, None] * tau
    q = (mass[:, None] * v)[:, None] + torch.einsum("pab,pib->pia", A, d)
    m = x.new_zeros(count * n**3).index_add(0, flat.flatten(), (weight * mass[:, None]).flatten())
    mv = x.new_zeros(count * n**3, 3).index_add(0, flat.flatten(), (weight[..., None] * q).flatten(0, 1))

    gravity = x.new_tensor(model.gravity)
    grid_v = torch.where(m[:, None] > 0, mv / m.clamp(min=1e-300)[:, None] + dt * gravity, 0.0)
    grid_v = torch.cat([walls(model, own.reshape(n, n, n, 3)).reshape(-1, 3) for own in grid_v.chunk(count)])
    if bodies:
        volumes, masses = (values.detach().split(bodies) for values in (vol0, mass))
        per_mass = [float(a.sum() / b.sum()) / dx**3 for a, b in zip(volumes, masses, strict=True)]
        grid_v = body_contact(model, grid_v.reshape(count, n, n, n, 3), m.reshape(count, n, n, n), per_mass)
        grid_v = grid_v.reshape(-1, 3)
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
    F = evaluate(regions, "plasticity", F + dt * C @ F)
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


def body_contact(model, v, m, per_mass):
    """Velocities (B, n, n, n, 3) of the nodes of B bodies after contact, from those before and the masses (B, n, n, n).

    See `neuma_lib.sim.body_contact`. ``per_mass`` is the volume fraction of a node per mass of each body.
    """
    frictions = {(pair.first, pair.second): min(pair.friction, 1e12) for pair in model.pairs}
    fractions = m * m.new_tensor(per_mass)[:, None, None, None]
    mean, step = m.new_tensor([0.25, 0.5, 0.25]), m.new_tensor([-0.5, 0.0, 0.5])
    kernels = [
        torch.einsum("i,j,k->ijk", *(step if axis == own else mean for axis in range(3))) for own in range(4)
    ]
    around = torch.nn.functional.conv3d(fractions[:, None], torch.stack(kernels)[:, None], padding=1)
    g, f = around[:, :3].movedim(1, -1), around[:, 3]
    after = list(v)
    for a in range(len(v)):
        for b in range(a + 1, len(v)):
            at = (m[a] > 0) & (m[b] > 0) & (g[a] != 0).any(dim=-1) & (g[b] != 0).any(dim=-1)
            f_a, f_b, g_a, g_b = f[a][at], f[b][at], g[a][at], g[b][at]
            n_a, n_b = g_a / g_a.norm(dim=-1, keepdim=True), -g_b / g_b.norm(dim=-1, keepdim=True)
            depths = g_a / f_a[:, None] - g_b / f_b[:, None]
            choice = (g_a.norm(dim=-1) / g_b.norm(dim=-1)).log() + (depths * (n_a - n_b)).sum(dim=-1)
            n = torch.lerp(n_b, n_a, torch.sigmoid(CHOICE * choice.clamp(-CERTAIN, CERTAIN))[:, None])
            n = n / n.norm(dim=-1, keepdim=True)
            gap, relative = (depths * n).sum(dim=-1) - 2, (v[a] - v[b])[at]
            p = -(n * relative).sum(dim=-1)
            touches = (gap < REACH) & (p > 0)
            q = relative + p[:, None] * n
            force = torch.where(touches[:, None], q, 1.0).norm(dim=-1)
            limit = frictions.get((a, b), 1e12) * p
            q = torch.where((force > limit)[:, None], (limit / force)[:, None] * q, q)
            strength = (f_a * f_b / (f_a + f_b) / COMMON).clamp(max=1) * (1 - gap / REACH).clamp(max=1)
            jump = torch.where(touches, strength, 0.0)[:, None] * (p[:, None] * n - q)
            total = m.sum(dim=0)[at]
            for own, other, sign in ((a, b, 1), (b, a, -1)):
                change = sign * (m[other][at] / total)[:, None] * jump
                after[own] = after[own].index_put((at,), change, accumulate=True)
    return torch.stack(after)


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


def evaluate(regions, part, F):
    """Elasticity or plasticity of every region."""
    return torch.cat([getattr(region.law, part)(F[region.start : region.stop]) for region in regions])


def branch(regions, F):
    """Logarithmic strains (N, 3) of the viscous branches without their mean, their axes (N, 3, 3), and the shear moduli
    and relaxation times of their laws (N, 1)."""
    values, axes = torch.linalg.eigh(F @ F.mT)
    log = 0.5 * values.log()
    constants = [
        viscous_branch(own.law.viscosity.values) for own in regions for _ in range(own.start, own.stop)
    ]
    G, T = (torch.stack([torch.as_tensor(c[k], dtype=F.dtype) for c in constants])[:, None] for k in (0, 1))
    return log - log.mean(1, keepdim=True), axes, G, T


def overstress(regions, F):
    """Kirchhoff stress 2 G dev eps of the branches (N, 3, 3)."""
    strain, axes, G, _ = branch(regions, F)
    return axes @ torch.diag_embed(2 * G * strain) @ axes.mT


def relaxed(regions, F, dt):
    """F (N, 3, 3) of the branches after an implicit step of the relaxation of their strain."""
    strain, axes, _, T = branch(regions, F)
    return axes @ torch.diag_embed((strain / (1 + dt / T) - strain).exp()) @ axes.mT @ F


def rollout(model, law, state, frames, total=False):
    """States (x, v, F, C) of a `State` at the frames, with the total deformation after them if asked for.

    Each has the shape (T, N, ...). With a viscous part of all laws, the state has an F_branch.
    """
    regions = as_regions(law, len(state.x))
    now, stuck, seen = state.motion, torch.zeros_like(state.x), []
    F_total = (state.F,) if total else ()
    clamp = clamped_particles(model.clamps, state.x) if state.clamp is None else state.clamp
    viscous, F_branch, over = regions[0].law.viscosity is not None, state.F_branch, 0.0
    for n in range(frames[-1] + 1):
        if n in frames:
            seen.append((*now, *F_total))
        if n < frames[-1]:
            if viscous:
                over = overstress(regions, F_branch)
            particles = state.mass, state.vol0
            *now, stuck = step(
                model, regions, *now, stuck, *particles, n * model.dt, clamp, over, state.bodies
            )
            if viscous:
                F_branch = relaxed(regions, F_branch + model.dt * now[3] @ F_branch, model.dt)
            F_total = tuple(F + model.dt * now[3] @ F for F in F_total)
    return tuple(torch.stack(values) for values in zip(*seen, strict=True))
