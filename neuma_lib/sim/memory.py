"""What a rollout keeps for its gradient and what it computes again: gradient checkpointing with a cache."""

from __future__ import annotations

import math
from dataclasses import dataclass

from neuma_lib.errors import InputError

DEFAULT_CACHE_BYTES = {"cpu": 1 << 29, "cuda": 1 << 32}
"""Memory for intermediate values of the steps, beyond their states, if the caller names none."""

_STATE_FLOATS = 24  # x, v, C, F of a particle
_TOTAL_FLOATS = 9  # its total F, where that is carried
_STEP_FLOATS = 18  # tau, F_trial of a particle
_NODE_FLOATS = 8  # grid, grid_v of a node


@dataclass(frozen=True)
class MemoryPlan:
    """What the reverse loop finds in memory.

    Attributes:
        segment: steps whose states are in memory together. If these are not all steps, the state before every
            segment is kept as a checkpoint, and the reverse loop computes a segment again before going back
            through it.
        caches_steps: whether stresses and grids of these steps are kept as well, not only their states.
        law_cache_bytes: memory left for what the laws keep of their evaluations.
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
) -> MemoryPlan:
    """The fastest plan that fits.

    Args:
        steps, particles, nodes: size of the rollout.
        itemsize: bytes of a number.
        cache_bytes: most bytes for intermediate values if all states fit; 0: these are always computed again.
        memory: most bytes for states and intermediate values together; None: no limit for the states.
        total: whether states hold the total deformation too.

    Raises:
        InputError: not even one step at a time fits into `memory`.
    """
    state = itemsize * (_STATE_FLOATS + total * _TOTAL_FLOATS) * particles
    step = itemsize * (_STEP_FLOATS * particles + _NODE_FLOATS * nodes)
    whole = state * (steps + 1) + step
    if memory is None or whole <= memory:
        if memory is not None:
            cache_bytes = min(cache_bytes, memory - whole)
        caches_steps = steps > 0 and step * steps <= cache_bytes
        return MemoryPlan(max(steps, 1), caches_steps, cache_bytes - step * steps if caches_steps else 0)

    # A longer segment costs no more time than a shorter one, so take the longest that fits.
    least = whole
    for caches_steps in (True, False) if cache_bytes else (False,):
        for segment in range(steps, 0, -1):
            size = state * (segment + 1 + math.ceil(steps / segment)) + step * (
                segment if caches_steps else 1
            )
            if size <= memory:
                return MemoryPlan(segment, caches_steps, 0)
            least = min(least, size)
    raise InputError(
        f"memory = {memory / 2**30:.3g} GiB is too little for {steps} steps of {particles} particles: their gradient "
        f"needs at least {least / 2**30:.3g} GiB; allow that much, or use fewer particles or steps"
    )
