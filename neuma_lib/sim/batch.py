"""Several simulations of a body in the same launches: other laws, other starts, for fits that compare many of them."""

from __future__ import annotations

from collections.abc import Sequence

import torch

from neuma_lib.errors import InputError, NonFiniteError
from neuma_lib.mechanics.analytic_fused import fusible, side_by_side
from neuma_lib.mechanics.law import Law
from neuma_lib.sim.model import Body, MPMModel
from neuma_lib.sim.rollout import check_inside, checked_frames, fly_and_simulate
from neuma_lib.sim.state import State, Trajectory

TOGETHER = {"cpu": 8, "cuda": 64}
"""Copies that share launches: a core saves what it takes to launch, a GPU is not full before."""


@torch.no_grad()
def rollout_batch(
    model: MPMModel,
    laws: Sequence[Law],
    start: State | Sequence[State],
    *,
    steps: int,
    frames: Sequence[int],
    total: bool = False,
    skip_free_flight: bool = True,
    scatter: str | None = None,
    together: int | None = None,
) -> list[Trajectory | None]:
    """As `rollout` for each of several laws, to round-off, without gradient and in fewer launches.

    Analytic laws that have kernels (`analytic_fused`) are evaluated in one launch, whatever their kinds and constants;
    of other laws only the transfers are shared.

    Args:
        model: as in `rollout`.
        laws: B materials, each of all particles.
        start: N particles at the start, for all laws or one for each.
        steps, frames, total, scatter: as in `rollout`.
        skip_free_flight: as in `rollout`, up to the first contact of any copy in the same launches.
        together: copies that share launches; None: `TOGETHER` of the device.

    Returns:
        The trajectory of each law, or None where it diverged, which leaves the others as they are.

    Raises:
        InputError: as `rollout`, or starts that are not as many as the laws or differ in their number of particles.
    """
    frames = checked_frames(frames, steps)
    starts = [start] * len(laws) if isinstance(start, State) else list(start)
    if not laws or len(starts) != len(laws) or len({len(state.x) for state in starts}) > 1:
        raise InputError(
            f"{len(laws)} laws and starts of {[len(state.x) for state in starts]} particles: give at least one law, "
            "and one start for all or one for each, with as many particles"
        )
    for state in {id(state): state for state in starts}.values():
        check_inside(model, state.x)
    found: list[Trajectory | None] = [None] * len(laws)
    order = sorted(range(len(laws)), key=lambda copy: not fusible(laws[copy]))
    together = together or TOGETHER[starts[0].x.device.type]
    for copies in (order[i : i + together] for i in range(0, len(laws), together)):
        own = [laws[copy] for copy in copies], [starts[copy] for copy in copies]
        paths = _side_by_side(model, *own, frames, total, skip_free_flight, scatter)
        for copy, path in zip(copies, paths, strict=True):
            found[copy] = path
    return found


def _side_by_side(
    model: MPMModel,
    laws: Sequence[Law],
    starts: Sequence[State],
    frames: tuple[int, ...],
    total: bool,
    skip_free_flight: bool,
    scatter: str | None,
) -> list[Trajectory | None]:
    """Laws in the same launches, those with kernels in front."""
    N, copies = len(starts[0].x), len(laws)
    fused = sum(map(fusible, laws))
    bodies = [Body(law, copy * N, (copy + 1) * N) for copy, law in enumerate(laws) if copy >= fused]
    if fused:
        bodies.insert(0, Body(side_by_side(laws[:fused], starts[0].x.device), 0, fused * N))
    state = State.joined(starts) if copies > 1 else starts[0]
    try:
        path, errors = fly_and_simulate(
            model, tuple(bodies), state, frames, None, total, skip_free_flight, scatter, copies
        )
    except NonFiniteError:
        return [None] * copies
    return [None if error else own for own, error in zip(path.split(copies), errors, strict=True)]
