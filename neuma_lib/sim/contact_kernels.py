"""Contact of particles with colliders as Warp functions. Warp derives the adjoint of a contact.

`colliders.Collider` has the equations. Several colliders act one after the other.
"""

import functools
from collections.abc import Sequence
from types import SimpleNamespace

import numpy as np
import torch
import warp as wp

from neuma_lib.device import start_warp
from neuma_lib.sim.colliders import CONTACT_STIFFNESS, SIZES, Collider

start_warp()

CODES = {shape: code for code, shape in enumerate(SIZES)}
STICKING = 1e12  # finite coefficient in place of infinity, whose adjoint would be infinity times zero
BOX, CAPSULE, MESH = CODES["box"], CODES["capsule"], CODES["mesh"]
ROUND = (CODES["sphere"], CAPSULE)


@functools.cache
def obstacle_type(dtype: torch.dtype) -> type:
    """Warp's struct of a collider at one time."""
    real = {torch.float32: wp.float32, torch.float64: wp.float64}[dtype]
    vec3 = wp.types.vector(length=3, dtype=real)
    mat33 = wp.types.matrix(shape=(3, 3), dtype=real)

    @wp.struct
    class Obstacle:
        shape: wp.int32
        size: vec3
        axes: mat33  # of its frame, as columns
        centre: vec3
        velocity: vec3
        spin: vec3
        friction: real
        damping: real
        # of a mesh, whose size is the position of its first node
        nodes: wp.vec3i
        first: wp.int32  # index of its first distance in `distances`
        spacing: real

    return Obstacle


def distances(colliders: Sequence[Collider]) -> np.ndarray:
    """Values of the distance grids of all meshes, one after the other, at least one number."""
    grids = [collider.distances.values.ravel() for collider in colliders if collider.distances]
    return np.concatenate(grids or [np.zeros(1, np.float32)])


@functools.lru_cache(maxsize=64)  # many simulations of a model have the same segments of steps
def obstacles(colliders: tuple[Collider, ...], times: tuple[float, ...], dtype: torch.dtype) -> np.ndarray:
    """Colliders at some times [s] as a structured array (times, colliders) in the layout of `obstacle_type`, which is
    not to be changed."""
    result = np.zeros((len(times), len(colliders)), dtype=obstacle_type(dtype).numpy_dtype())
    first = 0
    for k, collider in enumerate(colliders):
        column = result[:, k]
        column["shape"] = CODES[collider.shape]
        if grid := collider.distances:
            column["size"], column["spacing"] = grid.lowest, grid.spacing
            column["nodes"], column["first"] = grid.values.shape, first
            first += grid.values.size
        column["size"][:, : len(collider.size)] = collider.size
        for n, time in enumerate(times if collider.moves else times[:1]):
            axes, centre = collider.pose(time)
            velocity, spin = collider.rates(time)
            pose = {"axes": axes, "centre": centre, "velocity": velocity, "spin": spin}
            for name, value in pose.items():
                column[name][slice(n, n + 1 if collider.moves else None)] = value.numpy()
        column["damping"] = collider.damping
        column["friction"] = min(collider.friction, STICKING)
    result.setflags(write=False)
    return result


@functools.cache
def contact_functions(dtype: torch.dtype, features: tuple[str, ...] = ()) -> SimpleNamespace:
    """Functions `contact` and `contact_adjoint` for a precision and for planes and the shapes among the features.

    ``contact(obstacles, distances, pose, faces, dt, x, v, s, r)`` gives the velocity v and the tangential displacement
    s of a particle at x of radius r after contact with the obstacles of row ``pose``, and whether it touches one. The
    first ``faces`` obstacles, 6 or none, are those of the unit cube. ``contact_adjoint(..., g_v, g_s)`` takes gradients
    of the results of a particle that touches to those of x, v and s.
    """
    real = {torch.float32: wp.float32, torch.float64: wp.float64}[dtype]
    vec3, vec11 = (wp.types.vector(length=n, dtype=real) for n in (3, 11))
    Obstacle = obstacle_type(dtype)
    boxes, meshes = "box" in features, "mesh" in features
    rounded = "sphere" in features or "capsule" in features

    @wp.func
    def corners(o: Obstacle, distances: wp.array(dtype=real), x: vec3):
        """Distances at the corners of the cell of a mesh that is nearest to x, and the first node of the cell."""
        values = vec11()
        if wp.static(meshes):
            if o.shape == wp.static(MESH):
                scaled = (wp.transpose(o.axes) * (x - o.centre) - o.size) / o.spacing
                i = wp.clamp(wp.int32(scaled[0]), 0, o.nodes[0] - 2)
                j = wp.clamp(wp.int32(scaled[1]), 0, o.nodes[1] - 2)
                k = wp.clamp(wp.int32(scaled[2]), 0, o.nodes[2] - 2)
                for corner in range(8):
                    row = (i + corner / 4) * o.nodes[1] + j + corner / 2 % 2
                    values[corner] = distances[o.first + row * o.nodes[2] + k + corner % 2]
                values[8] = real(i)
                values[9] = real(j)
                values[10] = real(k)
        return values

    # One function, because Warp 1.19 leaves out the adjoint of a nested one that a forward function uses too.
    @wp.func
    def touched(o: Obstacle, d: vec11, dt: real, x: vec3, v: vec3, s: vec3, r: real):
        """Velocity after contact with one obstacle, and displacement s after the step (see `Collider`).

        d are the `corners` of a mesh.
        """
        zero, one = real(0.0), real(1.0)
        arm = x - o.centre
        y = wp.transpose(o.axes) * arm
        # outward normal in the frame of the obstacle, and signed distance
        normal = vec3(zero, one, zero)
        distance = y[1]
        if wp.static(boxes):
            if o.shape == wp.static(BOX):
                sign = vec3(
                    wp.where(y[0] < zero, -one, one),
                    wp.where(y[1] < zero, -one, one),
                    wp.where(y[2] < zero, -one, one),
                )
                q = wp.cw_mul(sign, y) - o.size
                if wp.max(q) > zero:
                    beyond = vec3(wp.max(q[0], zero), wp.max(q[1], zero), wp.max(q[2], zero))
                    distance = wp.length(beyond)
                    normal = wp.cw_mul(sign, beyond) / distance
                elif q[0] >= q[1] and q[0] >= q[2]:
                    normal = vec3(sign[0], zero, zero)
                    distance = q[0]
                elif q[1] >= q[2]:
                    normal = vec3(zero, sign[1], zero)
                    distance = q[1]
                else:
                    normal = vec3(zero, zero, sign[2])
                    distance = q[2]
        if wp.static(meshes):  # see `DistanceGrid`
            if o.shape == wp.static(MESH):
                high = o.size + o.spacing * vec3(
                    real(o.nodes[0] - 1), real(o.nodes[1] - 1), real(o.nodes[2] - 1)
                )
                within = vec3(
                    wp.clamp(y[0], o.size[0], high[0]),
                    wp.clamp(y[1], o.size[1], high[1]),
                    wp.clamp(y[2], o.size[2], high[2]),
                )
                beyond = y - within
                f = (within - o.size) / o.spacing - vec3(d[8], d[9], d[10])
                # differences along the first axis, then interpolation along the others
                e00, e01, e10, e11 = d[4] - d[0], d[5] - d[1], d[6] - d[2], d[7] - d[3]
                d00, d01, d10, d11 = (
                    d[0] + f[0] * e00,
                    d[1] + f[0] * e01,
                    d[2] + f[0] * e10,
                    d[3] + f[0] * e11,
                )
                d0, d1 = d00 + f[1] * (d10 - d00), d01 + f[1] * (d11 - d01)
                e0, e1 = e00 + f[1] * (e10 - e00), e01 + f[1] * (e11 - e01)
                distance = d0 + f[2] * (d1 - d0)
                slope = (
                    vec3(e0 + f[2] * (e1 - e0), d10 - d00 + f[2] * (d11 - d01 - (d10 - d00)), d1 - d0)
                    / o.spacing
                )
                if wp.length_sq(beyond) > zero:
                    slope = vec3(
                        wp.where(beyond[0] == zero, distance * slope[0], beyond[0]),
                        wp.where(beyond[1] == zero, distance * slope[1], beyond[1]),
                        wp.where(beyond[2] == zero, distance * slope[2], beyond[2]),
                    )
                    distance = wp.sqrt(wp.length_sq(beyond) + distance * distance)
                if wp.length_sq(slope) > zero:
                    normal = slope / wp.length(slope)
        if wp.static(rounded):
            if o.shape == wp.static(ROUND[0]) or o.shape == wp.static(ROUND[1]):
                along = zero
                radius = o.size[0]
                if o.shape == wp.static(CAPSULE):
                    along = wp.clamp(y[1], -o.size[0], o.size[0])
                    radius = o.size[1]
                from_axis = vec3(y[0], y[1] - along, y[2])
                length = wp.length(from_axis)
                distance = length - radius
                if length > zero:
                    normal = from_axis / length
        gap = distance - r
        after = v
        stuck = s
        if gap < zero:
            n = o.axes * normal
            u = o.velocity + wp.cross(o.spin, arm)
            stiffness = real(wp.static(CONTACT_STIFFNESS)) / dt
            impulse = -stiffness * gap - o.damping * wp.dot(n, v - u)
            if impulse > zero:
                slip = v - u
                slip = slip - wp.dot(slip, n) * n
                sticking = s - wp.dot(s, n) * n
                friction = slip + stiffness * sticking
                stuck = sticking + dt * slip
                force, limit = wp.length(friction), o.friction * impulse
                if force > limit:
                    friction = (limit / force) * friction
                    stuck = friction / stiffness
                after = v + impulse * n - friction
        return after, stuck

    @wp.func
    def weighted(o: Obstacle, d: vec11, dt: real, x: vec3, v: vec3, s: vec3, r: real, g_v: vec3, g_s: vec3):
        after, stuck = touched(o, d, dt, x, v, s, r)
        return wp.dot(after, g_v) + wp.dot(stuck, g_s)

    @wp.func
    def first_near(faces: wp.int32, x: vec3, r: real):
        """Index of the first obstacle that the particle may touch: it skips the faces of the cube."""
        inside = wp.min(x) >= r and wp.max(x) <= real(1.0) - r
        return wp.where(inside, faces, 0)

    @wp.func
    def near(faces: wp.int32, k: wp.int32, x: vec3, r: real):
        """Whether the particle may touch obstacle k: whether it is as near to a face of the cube (`WALLS`)."""
        place = x[k / 2 % 3]
        return k >= faces or wp.where(k % 2 == 0, place, real(1.0) - place) < r

    @wp.func
    def contact(
        obstacles: wp.array2d(dtype=Obstacle),
        distances: wp.array(dtype=real),
        pose: wp.int32,
        faces: wp.int32,
        dt: real,
        x: vec3,
        v: vec3,
        s: vec3,
        r: real,
    ):
        after = v  # one assignment each: several at once would alias v and s in Warp 1.19
        stuck = s
        touches = wp.int32(0)
        for k in range(first_near(faces, x, r), obstacles.shape[1]):
            if near(faces, k, x, r):
                d = corners(obstacles[pose, k], distances, x)
                changed, moved = touched(obstacles[pose, k], d, dt, x, after, stuck, r)
                if wp.length_sq(changed - after) > real(0.0):
                    touches = 1
                after = changed
                stuck = moved
        if touches == 0:
            stuck = vec3()
        return after, stuck, touches

    @wp.func
    def contact_adjoint(
        obstacles: wp.array2d(dtype=Obstacle),
        distances: wp.array(dtype=real),
        pose: wp.int32,
        faces: wp.int32,
        dt: real,
        x: vec3,
        v: vec3,
        s: vec3,
        r: real,
        g_after: vec3,
        g_stuck: vec3,
    ):
        first, last = first_near(faces, x, r), obstacles.shape[1] - 1
        g_x = vec3()
        g_v = g_after
        g_s = g_stuck
        for done in range(last + 1 - first):
            if near(faces, last - done, x, r):
                before = v
                stuck = s
                for k in range(first, last - done):
                    if near(faces, k, x, r):
                        d = corners(obstacles[pose, k], distances, x)
                        moved_v, moved_s = touched(obstacles[pose, k], d, dt, x, before, stuck, r)
                        before = moved_v
                        stuck = moved_s
                d = corners(obstacles[pose, last - done], distances, x)
                _o, _d, _dt, by_x, by_v, by_s, _r, _g, _h = wp.grad(weighted)(
                    obstacles[pose, last - done], d, dt, x, before, stuck, r, g_v, g_s
                )
                g_x = g_x + by_x
                g_v = by_v
                g_s = by_s
        return g_x, g_v, g_s

    return SimpleNamespace(contact=contact, contact_adjoint=contact_adjoint)
