"""Types of Warp for the simulator: numbers, constants of a model, and the arguments of kernels by their names.

Arguments of one name have one type in all kernels and functions. Only exceptions have an annotation.
"""

import functools
from types import SimpleNamespace

import torch
import warp as wp

from neuma_lib import device
from neuma_lib.sim.bodies import MAX_RANGES
from neuma_lib.sim.clamp_kernels import hold_type
from neuma_lib.sim.contact_kernels import obstacle_type

INDICES = "now after cached stressed pose step sort side again others count node p frame_of_x frame_of_F"
"""Integers: rows of arrays (`kernels`), nodes, particles, and switches."""

OF_STEPS = {
    "vec3": "x v stuck",
    "mat33": "C F F_trial F_total tau",
    "vec4": "grid grid_v grids grad_grid kept",
    "mat34": "grid_rows grid_v_rows grad_grid_rows",
    "int32": "order kept_spans",
}
"""Arrays whose first axis is the step. Functions get the row of one step."""

TABLES = {"Obstacle": "obstacles", "Hold": "holds", "real": "pairs", "int64": "faults"}  # arrays of two axes

ARRAYS = {
    "real": "mass vol0 radius mass_now vol_now radius_now held_mass distances",
    "vec3": "v_now x_after v_after grad_x grad_v grad_stuck",
    "mat33": "C_after grad_C grad_tau grad_F grad_F_trial grad_F_elastic grad_F_total",
    "vec4": "grad_before grad_around",
    "int32": "cell near touching spans clamp held_by first_of",
}
"""Arrays of one axis."""


@functools.cache
def warp_types(dtype: torch.dtype) -> SimpleNamespace:
    """Warp's scalar, vector and matrix types for a torch precision, and the struct of model constants."""
    real = {torch.float32: wp.float32, torch.float64: wp.float64}[dtype]
    types = SimpleNamespace(
        real=real,
        vec3=wp.types.vector(length=3, dtype=real),
        vec4=wp.types.vector(length=4, dtype=real),
        mat33=wp.types.matrix(shape=(3, 3), dtype=real),
        mat34=wp.types.matrix(shape=(3, 4), dtype=real),
        walls=wp.types.vector(length=6, dtype=wp.int32),
        starts=wp.types.vector(length=MAX_RANGES + 1, dtype=wp.int32),
        body_of=wp.types.vector(length=MAX_RANGES, dtype=wp.int32),
    )

    @wp.struct
    class GridConstants:
        n: wp.int32  # nodes along an edge
        particles: wp.int32  # per copy
        copies: wp.int32
        bodies: wp.int32  # per copy
        fields: wp.int32  # grids, one of each body of each copy
        ranges: wp.int32  # of particles of a copy that belong to one body
        starts: types.starts  # first particle of each range in its copy, and the end of the last
        body_of: types.body_of  # body of each range
        wall_nodes: wp.int32  # thickness of a wall
        faces: wp.int32  # first obstacles that are faces of the unit cube
        walls: types.walls  # condition on x_min, x_max, y_min, y_max, z_min, z_max
        first: real  # coordinate of node 0 [dx]
        dx: real  # node spacing [m]
        inv_dx: real
        dt: real  # [s]
        gravity: types.vec3  # [m/s^2]
        clamp_low: real  # bounds to which coordinates of particles are clamped [m]
        clamp_high: real
        leave_low: real  # bounds beyond which a particle has left the grid [m]
        leave_high: real

    types.GridConstants = GridConstants
    return types


@functools.cache
def _argument_types(dtype: torch.dtype, axes_of_steps: int) -> dict[str, type]:
    """Types of arguments by name, and of arrays of steps with one or two axes."""
    types = {
        **vars(warp_types(dtype)),
        "Obstacle": obstacle_type(dtype),
        "Hold": hold_type(dtype),
        "int32": wp.int32,
        "int64": wp.int64,
    }
    result = {"c": types["GridConstants"], **dict.fromkeys(INDICES.split(), wp.int32)}
    for table, axes in ((OF_STEPS, axes_of_steps), (TABLES, 2), (ARRAYS, 1)):
        for kind, names in table.items():
            result |= dict.fromkeys(names.split(), wp.array(dtype=types[kind], ndim=axes))
    return result


def typed(dtype: torch.dtype, axes_of_steps: int) -> SimpleNamespace:
    """`device.typed` for a precision and arrays of steps with two axes, or one in functions that get one step."""
    return device.typed(_argument_types(dtype, axes_of_steps))
