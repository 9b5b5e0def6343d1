"""Contact between bodies at the nodes that they share, as Warp functions. Warp derives the adjoint of a pair.

Each body has its own nodes (Bardenhagen et al. 2000). At a node, body a has the mass m_a and the velocity v_a. With the
mean f_a of its volume fraction over 27 nodes (weights 1/4, 1/2, 1/4 along an axis) and its gradient g_a by central
differences [1/dx], h_a = |g_a| / f_a measures the depth of the node in the body, also next to its edges: h is 0 deep
inside, about 1 at a plane surface, and 2 where the body ends. For a pair with the unit normal n, which points out of b,

    gap = (g_a . n / f_a - g_b . n / f_b - 2) dx

n is the direction of g_a or of -g_b, whichever surface is better resolved: steeper and with the larger gap. A logistic
function of log |g_a| / |g_b| + gap_a - gap_b joins both without a jump. With v = v_a - v_b:

    p = max(0, -n . v),   q = v + p n, shortened to at most ``friction`` p
    v_a += s (m_b / M) (p n - q),   v_b -= s (m_a / M) (p n - q),   M = sum of the masses of all bodies at the node

This is the impact of a Coulomb friction without rebound. Bodies rebound by their elasticity. s grows from 0 at a gap of
`REACH` to 1 where they touch, and with f_a f_b / (f_a + f_b) up to `COMMON`, since the gap is uncertain where one body
is scarce. Momentum is conserved. Bodies that part are free.
"""

import functools
from types import SimpleNamespace

import torch
import warp as wp

from neuma_lib.device import start_warp

start_warp()

REACH = 0.2
"""Gap at which contact starts [dx]. It reaches its full strength at 0."""
COMMON = 0.05
"""Least f_a f_b / (f_a + f_b) of full strength. It is 1/4 at the common surface of two bodies."""
CHOICE = 24.0
"""Sharpness of the choice between the normals of two bodies."""
CERTAIN = 2.0
"""Largest argument of the choice, which keeps its exponential finite."""


@functools.cache
def body_functions(dtype: torch.dtype, GridConstants: type) -> SimpleNamespace:
    """Functions of a node for a precision and the struct of `kernels.warp_types`.

    - ``change(c, pairs, grid, node)``: change of the velocity of a node by contact. ``pairs`` has a `bodies.pair_table`
      for each copy, shape (copies B, B + 1).
    - ``exchange(c, pairs, grid, grid_v, node, other)``: the same for a pair of nodes at the same place, added to both
      velocities after contact by one thread.
    - ``adjoint(c, pairs, grid, grad_grid, node, grad_before, grad_around)``: from the gradients of the velocities of
      all bodies after contact, sets those of the velocity before contact and of the mass at the node (grad_before), and
      of the gradient and mean of masses around it (grad_around).
    - ``mass_gradient(c, node, grad_before, grad_around)``: gradient of the mass of a node from those of all nodes.
    """
    real = {torch.float32: wp.float32, torch.float64: wp.float64}[dtype]
    vec3, vec4 = (wp.types.vector(length=n, dtype=real) for n in (3, 4))

    # One function, because Warp 1.19 leaves out the adjoint of a nested one that a forward function uses too.
    @wp.func
    def jump(friction: real, a: vec4, b: vec4, v: vec3):
        """s (p n - q) of a pair. a and b are the gradient and the mean of the volume fraction of each body."""
        zero, one = real(0.0), real(1.0)
        result = vec3()
        g_a, g_b = vec3(a[0], a[1], a[2]), vec3(b[0], b[1], b[2])
        steep_a, steep_b = wp.length(g_a), wp.length(g_b)
        if steep_a > zero and steep_b > zero:
            n_a, n_b = g_a / steep_a, -g_b / steep_b
            depths = g_a / a[3] - g_b / b[3]
            choice = wp.log(steep_a / steep_b) + wp.dot(depths, n_a - n_b)
            choice = wp.clamp(choice, real(wp.static(-CERTAIN)), real(wp.static(CERTAIN)))
            n = n_b + (n_a - n_b) / (one + wp.exp(-real(wp.static(CHOICE)) * choice))
            length = wp.length(n)
            if length > zero:
                n = n / length
                gap = wp.dot(depths, n) - real(2.0)
                approach = -wp.dot(n, v)
                if gap < real(wp.static(REACH)) and approach > zero:
                    q = v + approach * n
                    force, limit = wp.length(q), friction * approach
                    if force > limit:
                        q = (limit / force) * q
                    common = a[3] * b[3] / (a[3] + b[3])
                    strength = wp.min(one, common / real(wp.static(COMMON)))
                    strength = strength * wp.min(one, one - gap / real(wp.static(REACH)))
                    result = strength * (approach * n - q)
        return result

    @wp.func
    def weighted(friction: real, a: vec4, b: vec4, v: vec3, weight: vec3):
        return wp.dot(jump(friction, a, b, v), weight)

    @wp.func
    def first_body(c: GridConstants, node: wp.int32):
        """The same node of the first body of the copy."""
        count = c.n * c.n * c.n
        return node / (count * c.bodies) * c.bodies * count + node % count

    @wp.func
    def velocity(c: GridConstants, grid: wp.array(dtype=vec4), node: wp.int32):
        """Velocity before contact of a node with mass."""
        mv = grid[node]
        return vec3(mv[0], mv[1], mv[2]) / mv[3] + c.dt * c.gravity

    @wp.func
    def place_of(c: GridConstants, node: wp.int32):
        """Indices of a node along the axes."""
        place = node % (c.n * c.n * c.n)
        return wp.vec3i(place / (c.n * c.n), place / c.n % c.n, place % c.n)

    @wp.func
    def next_to(c: GridConstants, node: wp.int32, place: wp.vec3i, i: wp.int32, j: wp.int32, k: wp.int32):
        """The node at an offset of -1, 0 or 1 along each axis, or -1 at the end of the grid."""
        x, y, z = place[0] + i, place[1] + j, place[2] + k
        inside = wp.min(x, wp.min(y, z)) >= 0 and wp.max(x, wp.max(y, z)) < c.n
        return wp.where(inside, node + (i * c.n + j) * c.n + k, -1)

    @wp.func
    def filter(i: wp.int32, j: wp.int32, k: wp.int32):
        """Weights with which the mass at an offset counts for the gradient and the mean."""
        x, y, z = real(i), real(j), real(k)
        half, quarter = real(0.5), real(0.25)
        w_x, w_y, w_z = half - quarter * wp.abs(x), half - quarter * wp.abs(y), half - quarter * wp.abs(z)
        return vec4(half * x * w_y * w_z, half * y * w_x * w_z, half * z * w_x * w_y, w_x * w_y * w_z)

    @wp.func
    def around(c: GridConstants, grid: wp.array(dtype=vec4), node: wp.int32):
        """Gradient [1/dx] and mean of the mass of a body around a node."""
        total = vec4()
        place = place_of(c, node)
        for i in range(-1, 2):
            for j in range(-1, 2):
                for k in range(-1, 2):
                    other = next_to(c, node, place, i, j, k)
                    if other >= 0:
                        total += grid[other][3] * filter(i, j, k)
        return total

    @wp.func
    def total_mass(c: GridConstants, grid: wp.array(dtype=vec4), first: wp.int32):
        """Mass of all bodies at a node of the first."""
        mass = real(0.0)
        for b in range(c.bodies):
            mass += grid[first + b * c.n * c.n * c.n][3]
        return mass

    @wp.func
    def change(c: GridConstants, pairs: wp.array2d(dtype=real), grid: wp.array(dtype=vec4), node: wp.int32):
        result = vec3()
        count, first = c.n * c.n * c.n, first_body(c, node)
        m_a, mass = grid[node][3], total_mass(c, grid, first)
        if m_a > real(0.0) and mass > m_a:
            row, own = first / count, (node - first) / count
            a = pairs[row + own, c.bodies] * around(c, grid, node)
            v_a = velocity(c, grid, node)
            for b in range(c.bodies):
                other = first + b * count
                m_b = grid[other][3]
                if b != own and m_b > real(0.0):
                    v = v_a - velocity(c, grid, other)
                    j = jump(pairs[row + own, b], a, pairs[row + b, c.bodies] * around(c, grid, other), v)
                    result += (m_b / mass) * j
        return result

    @wp.func
    def exchange(
        c: GridConstants,
        pairs: wp.array2d(dtype=real),
        grid: wp.array(dtype=vec4),
        grid_v: wp.array(dtype=vec4),
        node: wp.int32,
        other: wp.int32,
    ):
        m_a, m_b, count = grid[node][3], grid[other][3], c.n * c.n * c.n
        if m_a > real(0.0) and m_b > real(0.0):
            first = first_body(c, node)
            row, a, b = first / count, (node - first) / count, (other - first) / count
            around_a = pairs[row + a, c.bodies] * around(c, grid, node)
            around_b = pairs[row + b, c.bodies] * around(c, grid, other)
            v = velocity(c, grid, node) - velocity(c, grid, other)
            j = jump(pairs[row + a, b], around_a, around_b, v) / total_mass(c, grid, first)
            grid_v[node] = grid_v[node] + m_b * vec4(j[0], j[1], j[2], real(0.0))
            grid_v[other] = grid_v[other] - m_a * vec4(j[0], j[1], j[2], real(0.0))

    @wp.func
    def adjoint(
        c: GridConstants,
        pairs: wp.array2d(dtype=real),
        grid: wp.array(dtype=vec4),
        grad_grid: wp.array(dtype=vec4),
        node: wp.int32,
        grad_before: wp.array(dtype=vec4),
        grad_around: wp.array(dtype=vec4),
    ):
        g = grad_grid[node]
        g_v = vec3(g[0], g[1], g[2])
        g_m = real(0.0)
        g_around = vec4()
        count, first = c.n * c.n * c.n, first_body(c, node)
        m, mass = grid[node][3], total_mass(c, grid, first)
        if m > real(0.0) and mass > m:
            row, own = first / count, (node - first) / count
            for k in range(c.bodies * c.bodies):
                a, b = k / c.bodies, k % c.bodies
                node_a, node_b = first + a * count, first + b * count
                m_a, m_b = grid[node_a][3], grid[node_b][3]
                if a < b and m_a > real(0.0) and m_b > real(0.0):
                    g_a, g_b = grad_grid[node_a], grad_grid[node_b]
                    by_a, by_b = vec3(g_a[0], g_a[1], g_a[2]), vec3(g_b[0], g_b[1], g_b[2])
                    weight = (m_b * by_a - m_a * by_b) / mass
                    around_a = pairs[row + a, c.bodies] * around(c, grid, node_a)
                    around_b = pairs[row + b, c.bodies] * around(c, grid, node_b)
                    v = velocity(c, grid, node_a) - velocity(c, grid, node_b)
                    friction = pairs[row + a, b]
                    j = jump(friction, around_a, around_b, v)
                    _friction, g_around_a, g_around_b, g_jump, _w = wp.grad(weighted)(
                        friction, around_a, around_b, v, weight
                    )
                    g_m = g_m - wp.dot(j, weight) / mass
                    if own == a:
                        g_v += g_jump
                        g_around += g_around_a
                        g_m = g_m - wp.dot(j, by_b) / mass
                    if own == b:
                        g_v = g_v - g_jump
                        g_around += g_around_b
                        g_m += wp.dot(j, by_a) / mass
            g_around = pairs[row + own, c.bodies] * g_around
        grad_before[node] = vec4(g_v[0], g_v[1], g_v[2], g_m)
        grad_around[node] = g_around

    @wp.func
    def mass_gradient(
        c: GridConstants, node: wp.int32, grad_before: wp.array(dtype=vec4), grad_around: wp.array(dtype=vec4)
    ):
        total = grad_before[node][3]
        place = place_of(c, node)
        for i in range(-1, 2):
            for j in range(-1, 2):
                for k in range(-1, 2):
                    other = next_to(c, node, place, i, j, k)
                    if other >= 0:
                        total += wp.dot(grad_around[other], filter(-i, -j, -k))
        return total

    return SimpleNamespace(change=change, exchange=exchange, adjoint=adjoint, mass_gradient=mass_gradient)
