"""What a rollout keeps for its reverse loop, and what it computes again to save memory."""

from __future__ import annotations

import math
from dataclasses import dataclass

from neuma_lib.errors import InputError

KEEP = {"auto": 1 << 29, "states": 0, "all": math.inf}
"""Bytes that a rollout on a CPU may spend on intermediate values for its reverse loop, beyond the states."""

GPU_FACTOR = 8
"""On a GPU "auto" may spend this many times as much."""

_STATE_FLOATS = 24  # x, v, C, F of a particle
_STEP_FLOATS = 18  # tau, F_trial of a particle
_NODE_FLOATS = 8  # grid, grid_v of a node


@dataclass(frozen=True)
class Storage:
    """How the steps of a differentiable rollout are stored.

    Attributes:
        segment: steps whose states are held at a time. If these are not all steps, the first state of every
            segment is kept and the reverse loop computes the segment again before it goes back through it.
        keeps: whether each step of a segment also keeps its stresses and grids.
        cache_bytes: bytes left for what the laws keep of their evaluations.
    """

    segment: int
    keeps: bool
    cache_bytes: float


def plan_storage(
    steps: int, particles: int, nodes: int, itemsize: int, keep: str, memory: float | None, on_gpu: bool
) -> Storage:
    """The fastest storage that fits.

    Args:
        steps, particles, nodes: size of the rollout.
        itemsize: bytes of a number.
        keep: see `KEEP`.
        memory: most bytes for states and intermediate values together; None bounds the intermediate values only.

    Raises:
        InputError: not even one step at a time fits into `memory`.
    """
    state = itemsize * _STATE_FLOATS * particles
    step = itemsize * (_STEP_FLOATS * particles + _NODE_FLOATS * nodes)
    limit = KEEP[keep] * (GPU_FACTOR if on_gpu and keep == "auto" else 1)
    whole = state * (steps + 1) + step
    if memory is None or whole <= memory:
        if memory is not None:
            limit = min(limit, memory - whole)
        keeps = steps > 0 and step * steps <= limit
        return Storage(max(steps, 1), keeps, limit - step * steps if keeps else 0)

    # A longer segment costs no more time than a shorter one, so take the longest that fits.
    least = whole
    for keeps in (False,) if keep == "states" else (True, False):
        for segment in range(steps, 0, -1):
            size = state * (segment + 1 + math.ceil(steps / segment)) + step * (segment if keeps else 1)
            if size <= memory:
                return Storage(segment, keeps, 0)
            least = min(least, size)
    raise InputError(
        f"memory = {memory / 2**30:.3g} GiB is too little for {steps} steps of {particles} particles: their gradient "
        f"needs at least {least / 2**30:.3g} GiB; allow that much, or use fewer particles or steps"
    )
