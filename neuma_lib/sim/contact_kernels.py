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
            place = slice(n, n + 1 if collider.moves else None)
            column["axes"][place], column["centre"][place] = axes.numpy(), centre.numpy()
        for name in ("velocity", "spin", "damping"):
            column[name] = getattr(collider, name)
        column["friction"] = min(collider.friction, STICKING)
    return result


@functools.cache
def contact_functions(dtype: torch.dtype) -> SimpleNamespace:
    """Functions `contact` and `contact_adjoint` for a precision.

    ``contact(obstacles, pose, faces, dt, x, v, r)`` is the velocity of a particle at x with velocity v and radius r
    after contact with the obstacles of row ``pose``. The first ``faces`` of them, 6 or none, are those of the unit
    cube. ``contact_adjoint(..., g)`` takes the gradient g of the result to those of x and v.
    """
    real = {torch.float32: wp.float32, torch.float64: wp.float64}[dtype]
    vec3 = wp.types.vector(length=3, dtype=real)
    Obstacle = obstacle_type(dtype)

    # One function, because Warp 1.19 leaves out the adjoint of a nested one that a forward function uses too.
    @wp.func
    def touched(o: Obstacle, dt: real, x: vec3, v: vec3, r: real):
        """Velocity after contact with one obstacle."""
        zero, one = real(0.0), real(1.0)
        arm = x - o.centre
        y = wp.transpose(o.axes) * arm
        # outward normal in the frame of the obstacle, and signed distance
        normal, distance = vec3(zero, one, zero), y[1]
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
                normal, distance = vec3(sign[0], zero, zero), q[0]
            elif q[1] >= q[2]:
                normal, distance = vec3(zero, sign[1], zero), q[1]
            else:
                normal, distance = vec3(zero, zero, sign[2]), q[2]
        elif o.shape != wp.static(PLANE):
            along, radius = zero, o.size[0]
            if o.shape == wp.static(CAPSULE):
                along, radius = wp.clamp(y[1], -o.size[0], o.size[0]), o.size[1]
            from_axis = vec3(y[0], y[1] - along, y[2])
            length = wp.length(from_axis)
            distance = length - radius
            if length > zero:
                normal = from_axis / length
        gap = distance - r
        result = v
        if gap < zero:
            n = o.axes * normal
            u = o.velocity + wp.cross(o.spin, arm)
            impulse = -real(wp.static(CONTACT_STIFFNESS)) * gap / dt - o.damping * wp.dot(n, v - u)
            if impulse > zero:
                after = v + impulse * n
                slip = after - u
                slip = slip - wp.dot(slip, n) * n
                speed = wp.length(slip)
                limit = o.friction * impulse
                if speed <= limit:
                    result = after - slip
                else:
                    result = after - (limit / speed) * slip
        return result

    @wp.func
    def weighted(o: Obstacle, dt: real, x: vec3, v: vec3, r: real, g: vec3):
        return wp.dot(touched(o, dt, x, v, r), g)

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
        r: real,
    ):
        result = v
        for k in range(first_near(faces, x, r), obstacles.shape[1]):
            result = touched(obstacles[pose, k], dt, x, result, r)
        return result

    @wp.func
    def contact_adjoint(
        obstacles: wp.array2d(dtype=Obstacle),
        pose: wp.int32,
        faces: wp.int32,
        dt: real,
        x: vec3,
        v: vec3,
        r: real,
        g: vec3,
    ):
        first = first_near(faces, x, r)
        g_x = vec3()
        g_v = g
        for reverse in range(first, obstacles.shape[1]):
            last = first + obstacles.shape[1] - 1 - reverse
            before = v
            for k in range(first, last):
                before = touched(obstacles[pose, k], dt, x, before, r)
            _o, _dt, by_x, by_v, _r, _g = wp.grad(weighted)(obstacles[pose, last], dt, x, before, r, g_v)
            g_x = g_x + by_x
            g_v = by_v
        return g_x, g_v

    return SimpleNamespace(contact=contact, contact_adjoint=contact_adjoint)
