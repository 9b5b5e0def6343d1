"""Contact of particles with colliders as Warp functions. Warp derives the adjoint of a contact.

`colliders.Collider` has the equations. Several colliders act one after the other.
"""

# No `from __future__ import annotations` here: Warp reads the annotations of functions as objects.
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
STICKING = 1e12
"""Finite coefficient in place of infinity, whose adjoint would be infinity times zero."""
PLANE, BOX, CAPSULE = CODES["plane"], CODES["box"], CODES["capsule"]


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

    return Obstacle


def obstacles(colliders: Sequence[Collider], times: Sequence[float], dtype: torch.dtype) -> np.ndarray:
    """Colliders at some times [s] as a structured array (times, colliders) in the layout of `obstacle_type`."""
    result = np.zeros((len(times), len(colliders)), dtype=obstacle_type(dtype).numpy_dtype())
    for k, collider in enumerate(colliders):
        column = result[:, k]
        column["shape"] = CODES[collider.shape]
        column["size"][:, : len(collider.size)] = collider.size
        for n, time in enumerate(times if collider.moves else times[:1]):
            axes, centre = collider.pose(time)
            velocity, spin = collider.rates(time)
            pose = {"axes": axes, "centre": centre, "velocity": velocity, "spin": spin}
            for name, value in pose.items():
                column[name][slice(n, n + 1 if collider.moves else None)] = value.numpy()
        column["damping"] = collider.damping
        column["friction"] = min(collider.friction, STICKING)
    return result


@functools.cache
def contact_functions(dtype: torch.dtype) -> SimpleNamespace:
    """Functions `contact` and `contact_adjoint` for a precision.

    ``contact(obstacles, pose, faces, dt, x, v, s, r)`` gives the velocity v and the tangential displacement s of a
    particle at x of radius r after contact with the obstacles of row ``pose``, and whether it touches one. The first
    ``faces`` obstacles, 6 or none, are those of the unit cube. ``contact_adjoint(..., g_v, g_s)`` takes gradients of
    the results of a particle that touches to those of x, v and s.
    """
    real = {torch.float32: wp.float32, torch.float64: wp.float64}[dtype]
    vec3 = wp.types.vector(length=3, dtype=real)
    Obstacle = obstacle_type(dtype)

    # One function, because Warp 1.19 leaves out the adjoint of a nested one that a forward function uses too.
    @wp.func
    def touched(o: Obstacle, dt: real, x: vec3, v: vec3, s: vec3, r: real):
        """Velocity after contact with one obstacle, and displacement s after the step (see `Collider`)."""
        zero, one = real(0.0), real(1.0)
        arm = x - o.centre
        y = wp.transpose(o.axes) * arm
        # outward normal in the frame of the obstacle, and signed distance
        normal = vec3(zero, one, zero)
        distance = y[1]
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
        elif o.shape != wp.static(PLANE):
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
    def weighted(o: Obstacle, dt: real, x: vec3, v: vec3, s: vec3, r: real, g_v: vec3, g_s: vec3):
        after, stuck = touched(o, dt, x, v, s, r)
        return wp.dot(after, g_v) + wp.dot(stuck, g_s)

    @wp.func
    def first_near(faces: wp.int32, x: vec3, r: real):
        """Index of the first obstacle that the particle may touch: it skips the faces of the cube."""
        inside = wp.min(x) >= r and wp.max(x) <= real(1.0) - r
        return wp.where(inside, faces, 0)

    @wp.func
    def contact(
        obstacles: wp.array2d(dtype=Obstacle),
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
            changed, moved = touched(obstacles[pose, k], dt, x, after, stuck, r)
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
            before = v
            stuck = s
            for k in range(first, last - done):
                moved_v, moved_s = touched(obstacles[pose, k], dt, x, before, stuck, r)
                before = moved_v
                stuck = moved_s
            _o, _dt, by_x, by_v, by_s, _r, _g, _h = wp.grad(weighted)(
                obstacles[pose, last - done], dt, x, before, stuck, r, g_v, g_s
            )
            g_x = g_x + by_x
            g_v = by_v
            g_s = by_s
        return g_x, g_v, g_s

    return SimpleNamespace(contact=contact, contact_adjoint=contact_adjoint)
