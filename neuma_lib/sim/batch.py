"""Several simulations of a body with different laws or initial states, in the same launches or in threads."""

import logging
from collections.abc import Sequence
from itertools import chain

import torch

from neuma_lib.errors import InputError, NonFiniteError
from neuma_lib.mechanics.law import Law
from neuma_lib.mechanics.side_by_side import fusible, has_kernels, side_by_side
from neuma_lib.sim.model import MPM, consecutive, model_of_each, with_fields
from neuma_lib.sim.rollout import check_bodies, check_inside, checked_frames, fly_and_simulate
from neuma_lib.sim.state import State, Trajectory
from neuma_lib.threads import in_threads

_LOGGER = logging.getLogger(__name__)
TOGETHER = {"cpu": 1, "cuda": 64}
"""Copies that share launches. A GPU needs that many to be fully used. A core is fastest with one, which stays in its
cache."""


def rollout_batch(
    model: MPM | Sequence[MPM],
    laws: Sequence[Law | Sequence[Law]],
    start: State | Sequence[State],
    *,
    steps: int,
    frames: Sequence[int],
    total: bool = False,
    skip_free_flight: bool = True,
    together: int | None = None,
) -> list[Trajectory | None]:
    """`rollout` for each of several laws, equal to round-off, without gradients.

    On a GPU, copies share launches. Analytic laws with kernels (`analytic_kernels`) are evaluated in one launch for any
    kinds and constants. Other laws share only the transfers, those with a viscous part nothing. On a CPU, copies of
    laws with kernels run in threads (`threads.in_threads`), with the same results for any number of threads.

    Args:
        model: as in `rollout`, one for all laws or one per law. They may differ in friction.
        laws: B laws, each for all particles, or sequences of the laws of all bodies of the states, in their order.
        start: N particles, one initial state for all laws or one per law.
        steps, frames, total: as in `rollout`.
        skip_free_flight: as in `rollout`, up to the first contact of any copy in the same launches.
        together: number of copies that share launches, by default `TOGETHER` of the device.

    Returns:
        The trajectory of each law, or None where it diverged. The log (level INFO) states why.

    Raises:
        InputError: as `rollout`, or the numbers of laws, models, initial states, bodies or their particles do not
            match, or the models differ in more than friction.
    """
    frames = checked_frames(frames, steps)
    starts = [start] * len(laws) if isinstance(start, State) else list(start)
    alike = len({(len(state.x), state.bodies) for state in starts}) == 1
    if not laws or len(starts) != len(laws) or not alike:
        raise InputError(
            "laws",
            f"{len(laws)} laws do not match initial states of {[len(state.x) for state in starts]} particles",
            "Give one state for all laws or one per law, with equal numbers of particles",
        )
    if wrong := {_bodies(own) for own in laws} - {1, len(starts[0].bodies)}:
        problem = f"{wrong.pop()} laws do not match {max(1, len(starts[0].bodies))} bodies"
        raise InputError("laws", problem, "Give one law for all particles, or one per body")
    models = model_of_each(model, len(laws))
    model = models[0]
    if any(own.frictionless != model.frictionless for own in models):
        raise InputError("model", "the models must be equal up to friction", "Give one for all")
    for state in {id(state): state for state in starts}.values():
        check_bodies(model, state)
        check_inside(model, state.x)
    starts = [
        with_fields(state, consecutive(_each(own), state.bodies if _bodies(own) > 1 else (len(state.x),)))
        for own, state in zip(laws, starts, strict=True)
    ]
    order = sorted(range(len(laws)), key=lambda copy: not _fusible(laws[copy]))
    device, dtype = starts[0].x.device, starts[0].x.dtype
    together = together or TOGETHER[device.type]
    viscous = [copy for copy in order if any(law.viscosity is not None for law in _each(laws[copy]))]
    order = [copy for copy in order if copy not in viscous]
    groups = [order[i : i + together] for i in range(0, len(order), together)] + [[copy] for copy in viscous]

    def simulated(copies: Sequence[int]) -> list[Trajectory | None]:
        own = [laws[copy] for copy in copies], [starts[copy] for copy in copies]
        frictions = [models[copy].frictions for copy in copies]
        return _side_by_side(model, *own, frames, total, skip_free_flight, frictions)

    every = [law for own in laws for law in _each(own)]
    threads = 1 if device.type == "cuda" or not all(map(has_kernels, every)) else None
    kernels = [(rollout_batch, model.frictionless, dtype, total, _kinds(laws, copies)) for copies in groups]
    paths = in_threads(simulated, groups, kernels, threads)
    result: list[Trajectory | None] = [None] * len(laws)
    for copy, path in zip(order + viscous, chain.from_iterable(paths), strict=True):
        result[copy] = path
    return result


@torch.no_grad()
def _kinds(laws: Sequence[Law | Sequence[Law]], copies: Sequence[int]) -> tuple[tuple[type, ...], ...]:
    """Classes of the parts of some laws, which determine their kernels."""
    return tuple(
        tuple(type(part) for part in (law.elasticity, law.plasticity, law.viscosity))
        for copy in copies
        for law in _each(laws[copy])
    )


def _each(laws: Law | Sequence[Law]) -> tuple[Law, ...]:
    """The law of all particles, or the laws of the bodies."""
    return (laws,) if isinstance(laws, Law) else tuple(laws)


def _bodies(laws: Law | Sequence[Law]) -> int:
    return len(_each(laws))


def _fusible(laws: Law | Sequence[Law]) -> bool:
    """Whether a copy shares launches of its laws with others, whose ranges of particles are equally long."""
    return isinstance(laws, Law) and fusible(laws)


def _side_by_side(
    model: MPM,
    laws: Sequence[Law | Sequence[Law]],
    starts: Sequence[State],
    frames: tuple[int, ...],
    total: bool,
    skip_free_flight: bool,
    frictions: Sequence[Sequence[float]],
) -> list[Trajectory | None]:
    """Simulate laws in the same launches, those with fused kernels first."""
    N, copies = len(starts[0].x), len(laws)
    fused, counts = sum(map(_fusible, laws)), starts[0].bodies
    together = [side_by_side(laws[:fused], starts[0].x.device)] if fused else []
    alone = [
        (law, n)
        for own in laws[fused:]
        for law, n in zip(_each(own), counts if _bodies(own) > 1 else (N,), strict=True)
    ]
    sizes = [fused * N] * len(together) + [n for _, n in alone]
    regions = consecutive([*together, *(law for law, _ in alone)], sizes)
    state = State.joined(starts) if copies > 1 else starts[0]
    try:
        path, errors = fly_and_simulate(
            model,
            regions,
            state,
            frames,
            None,
            total,
            skip_free_flight,
            copies,
            frictions=frictions,
            bodies=starts[0].bodies,
        )
    except NonFiniteError as error:
        if copies > 1 and error.step is None:  # from the code of a law, which does not state the copy
            alone = ((laws[k : k + 1], starts[k : k + 1], frictions[k : k + 1]) for k in range(copies))
            options = frames, total, skip_free_flight
            return [_side_by_side(model, *own, *options, each)[0] for *own, each in alone]
        _LOGGER.info("no copy of %d is finite: %s", copies, error)
        return [None] * copies
    for copy, error in enumerate(errors):
        if error:
            _LOGGER.info("copy %d of %d is left out: %s", copy, copies, error)
    return [None if error else own for own, error in zip(path.split(copies), errors, strict=True)]
