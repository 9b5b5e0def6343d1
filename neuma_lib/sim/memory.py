"""Memory plan of a differentiable rollout: gradient checkpointing with a cache."""

import math
from dataclasses import dataclass

from neuma_lib.errors import InputError

DEFAULT_CACHE_BYTES = {"cpu": 1 << 29, "cuda": 1 << 32}
"""Default memory for intermediate values of the steps, in addition to their states."""

_STATE_FLOATS = 24  # x, v, C, F of a particle
_TOTAL_FLOATS = 9  # F_total of a particle
_CONTACT_FLOATS = 3  # tangential displacement of a particle in contact
_STEP_FLOATS = 18  # tau, F_trial of a particle
_NODE_FLOATS = 8  # grid, grid_v of a node

# if steps share their grids, and only the nodes that particles touch are kept:
_NEXT_FLOATS = 9  # tau after the last step of a particle
_REUSED_NODE_FLOATS = 12  # grid, grid_v and grad_grid of a node
_BODIES_NODE_FLOATS = 8  # grad_before and grad_around of a node, with several bodies
_KEPT_FLOATS = 4  # momentum and mass of a touched node, at most one for each particle
_KEPT_ROW_BYTES = 8  # bounds of the touched nodes of a row


@dataclass(frozen=True)
class MemoryPlan:
    """Values that the reverse loop has in memory.

    Attributes:
        segment: number of consecutive steps whose states are in memory. If there are several segments, the state
            before each is kept as a checkpoint, and the reverse loop recomputes a segment from it.
        caches_steps: whether stresses, trial deformations and perhaps grids of these steps are kept in addition to
            their states.
        law_cache_bytes: memory left for the caches of the laws.
    """

    segment: int
    caches_steps: bool
    law_cache_bytes: float


def plan_memory(
    steps: int,
    particles: int,
    nodes: int,
    itemsize: int,
    cache_bytes: float,
    memory: float | None = None,
    total: bool = False,
    contact: bool = False,
    rows: int = 0,
    bodies: bool = False,
) -> MemoryPlan:
    """The fastest plan that fits into memory.

    Args:
        steps, particles, nodes: size of the rollout.
        itemsize: bytes per number.
        cache_bytes: maximum bytes for intermediate values if all states fit; 0 always recomputes them.
        memory: maximum bytes for states and intermediate values together; None does not limit the states.
        total: whether states include the total deformation.
        contact: whether states include the tangential displacement of contact of particles.
        rows: number of rows of nodes of all copies if the steps share their grids, 0 if each has its own.
        bodies: whether there are several bodies.

    Raises:
        InputError: segments of a single step do not fit into `memory`.
    """
    state = itemsize * (_STATE_FLOATS + total * _TOTAL_FLOATS + contact * _CONTACT_FLOATS) * particles
    step, shared = itemsize * _STEP_FLOATS * particles, 0
    if rows:
        step += itemsize * _KEPT_FLOATS * particles + _KEPT_ROW_BYTES * rows
        node = _REUSED_NODE_FLOATS + bodies * _BODIES_NODE_FLOATS
        shared = itemsize * (node * nodes + _NEXT_FLOATS * particles)
    else:
        step += itemsize * _NODE_FLOATS * nodes
    whole = state * (steps + 1) + step + shared
    if memory is None or whole <= memory:
        if memory is not None:
            cache_bytes = min(cache_bytes, memory - whole)
        caches_steps = steps > 0 and step * steps <= cache_bytes
        return MemoryPlan(max(steps, 1), caches_steps, cache_bytes - step * steps if caches_steps else 0)

    # The time does not depend on the length of the segments, so choose the longest that fits.
    needed = whole
    for caches_steps in (True, False) if cache_bytes else (False,):
        for segment in range(steps, 0, -1):
            states = segment + 1 + math.ceil(steps / segment)
            size = state * states + step * (segment if caches_steps else 1) + shared
            if size <= memory:
                return MemoryPlan(segment, caches_steps, 0)
            needed = min(needed, size)
    raise InputError(
        "memory",
        f"{memory / 2**30:.3g} GiB must be at least {needed / 2**30:.3g} GiB to differentiate {steps} steps of "
        f"{particles} particles",
        "Raise the limit, or use fewer particles or steps",
    )
