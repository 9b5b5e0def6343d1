"""Entry point of the simulator.

For autograd a rollout is one function from (x, v, F, C, weights of the laws) to the states at the frames, whose
gradient is one reverse loop over the stored states. The total deformation and, with contact of particles, the
displacements of friction are further parts of the state.
"""

import logging
from collections.abc import Sequence
from functools import cache

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from neuma_lib.errors import InputError, NonFiniteError
from neuma_lib.mechanics.law import Law
from neuma_lib.sim.branches import branched, merged
from neuma_lib.sim.free_flight import ballistic, free_flight_steps
from neuma_lib.sim.memory import DEFAULT_CACHE_BYTES, plan_memory
from neuma_lib.sim.model import MPM, MaterialRegion, as_regions, with_fields
from neuma_lib.sim.scatter import scatter_for
from neuma_lib.sim.simulation import Simulation, gather_weights
from neuma_lib.sim.state import State, Trajectory

_LOGGER = logging.getLogger(__name__)


def rollout(
    model: MPM,
    law: Law | Sequence[MaterialRegion],
    state: State,
    *,
    steps: int,
    frames: Sequence[int],
    tracers: Tensor | None = None,
    tracer_bodies: Sequence[int] = (),
    total: bool = False,
    skip_free_flight: bool = True,
    memory: float | None = None,
    cache_bytes: float | None = None,
    scatter: str | None = None,
) -> Trajectory:
    """Simulate particles and return their states at the frames (paper Eq. 1).

    Differentiable with respect to the weights of the laws and to x, v, F, C and stuck of the state. Masses, volumes and
    tracers have no gradient.

    Args:
        model: grid, time step, gravity, walls, colliders and clamps.
        law: law of all particles, or regions with their own laws.
        state: initial state of N particles. Fields of laws need the body at rest, unless the state has ``stiffness``.
        steps: number of time steps, not less than the last frame, at which the simulation ends.
        frames: steps whose states are returned, strictly increasing, 0 is the initial state.
        tracers: positions of passive points that follow the velocity of the grid [m], shape (M, 3).
        tracer_bodies: number of tracers of each body, one after the other, if the state has several bodies.
        total: also compute the total deformation, F_total = (I + dt C) F_total without plastic return, initially F.
            Differentiable like F.
        skip_free_flight: compute the steps before the first contact in closed form if the state is undeformed and
            has a uniform velocity, equal to simulated steps to round-off in value and gradient. Not used with clamps,
            several bodies, or if a gradient is required of v of shape (N, 3), F or C.
        memory: maximum bytes kept for the gradient, None for no limit. If it is less than the states of all steps
            need, these are recomputed segment by segment, with the same gradient.
        cache_bytes: maximum bytes for stresses, grids and caches of the laws, None for
            `memory.DEFAULT_CACHE_BYTES`. Other values are recomputed, with the same gradient.
        scatter: scatter method, see `scatter`. None chooses the fastest.

    Raises:
        InputError: invalid frames, tracers or regions, a particle starts outside the grid, or several bodies with
            contact of nodes or clamps.
        NonFiniteError: a particle became non-finite, moved by more than a cell in a step or left the grid; has
            `step` and `particle`.
    """
    frames = checked_frames(frames, steps)
    regions = as_regions(law, len(state.x))
    state = with_fields(state, regions)
    check_inside(model, state.x)
    if tracers is not None and (tracers.ndim != 2 or tracers.shape[1] != 3 or tracers.dtype != state.x.dtype):
        given = f"shape {tuple(tracers.shape)} as {tracers.dtype}"
        raise InputError("tracers", f"{given} must be (M, 3) as {state.x.dtype}")

    check_bodies(model, state)
    if tracers is not None and state.bodies and sum(tracer_bodies) != len(tracers):
        problem = f"{list(tracer_bodies)} must be the numbers of tracers of each body, {len(tracers)} in all"
        raise InputError("tracer_bodies", problem)

    for region in regions:
        if region.law.grid not in (None, model.grid):
            _warn_of_another_grid(region.law.name, region.law.grid, model.grid)
    path, _ = fly_and_simulate(
        model,
        regions,
        state,
        frames,
        tracers,
        total,
        skip_free_flight,
        scatter=scatter,
        memory=memory,
        cache_bytes=cache_bytes,
        bodies=state.bodies,
        tracer_bodies=tracer_bodies,
    )
    return path


@cache
def _warn_of_another_grid(name: str, learned: int, used: int) -> None:
    """Warn once that a law is used on another grid than the one whose discretisation error it has absorbed."""
    _LOGGER.warning(
        "law %r was learned on a grid of %d cells along the cube and is used on one of %d: its motion there differs by "
        "the discretisation error that it has absorbed",
        name,
        learned,
        used,
    )


@cache
def _log_evaluation(law: str, native: bool) -> None:
    """Log once how a law is evaluated."""
    _LOGGER.info("%s is evaluated by %s", law, "native kernels" if native else "torch, which is slower")


def simulate(
    mpm: MPM,
    law: Law | Sequence[MaterialRegion],
    state: State,
    frames: Sequence[int],
    *,
    tracers: Tensor | None = None,
    total: bool = False,
) -> Trajectory:
    """Simulate particles up to the last frame and return their states at the frames.

    Differentiable with respect to the weights of the law and to x, v, F and C of the state. `rollout` has further
    options for speed and memory.

    Args:
        mpm: grid, time step, gravity and walls.
        law: law of all particles, or one `MaterialRegion` per range of particles.
        state: initial state of N particles.
        frames: time steps whose states are returned, strictly increasing, 0 is the initial state.
        tracers: positions of passive points that follow the velocity of the grid [m], shape (M, 3).
        total: also compute the total deformation gradients, elastic and plastic.

    Returns:
        States at the T frames: x (T, N, 3) [m], v [m/s], F and C.

    Raises:
        InputError: invalid frames or tracers, or a particle starts outside the grid.
        NonFiniteError: the simulation is unstable, or a particle leaves the grid.

    Example:
        >>> path = simulate(MPM(grid=24, dt=1e-3), law, state, frames=range(0, 201, 10))
        >>> path.x.shape  # 21 frames
        torch.Size([21, 2000, 3])
    """
    frames = tuple(frames)
    last = frames[-1] if frames else 0
    return rollout(mpm, law, state, steps=last, frames=frames, tracers=tracers, total=total)


def fly_and_simulate(
    model: MPM,
    regions: tuple[MaterialRegion, ...],
    state: State,
    frames: tuple[int, ...],
    tracers: Tensor | None,
    total: bool,
    skip_free_flight: bool,
    copies: int = 1,
    scatter: str | None = None,
    memory: float | None = None,
    cache_bytes: float | None = None,
    frictions: Sequence[Sequence[float]] | None = None,
    bodies: tuple[int, ...] = (),
    tracer_bodies: Sequence[int] = (),
) -> tuple[Trajectory, list[NonFiniteError | None]]:
    """`rollout` with checked arguments, for a state of several ``copies`` with equal numbers of particles, their
    `MPM.frictions` if they differ, and the particles of each body of a copy if there are several.

    Returns one error per copy, or None. The states of a copy with an error are undefined. If all copies have one, the
    first is raised.
    """
    count, both = len(state.x), branched(regions, state)
    if both:
        if copies > 1:
            problem = "those with a viscous part share no launches"
            raise InputError("laws", problem, "Simulate them one by one")
        regions, state, owners = both
    ranges = tuple((size, body) for body, size in enumerate(bodies))
    if both and bodies:  # branches belong to the bodies of their particles, in the same order
        ends = torch.tensor(bodies).cumsum(0)
        of_body = torch.bincount(torch.searchsorted(ends, owners.cpu(), right=True), minlength=len(bodies))
        ranges += tuple((size, body) for body, size in enumerate(of_body.tolist()) if size)

    def of_laws(path: Trajectory) -> Trajectory:
        return merged(path, owners, count) if both else path

    for region in regions:
        for part in (region.law.elasticity, region.law.plasticity):
            for own in getattr(part, "parts", (part,)):
                _log_evaluation(type(own).__name__, own.native)
    flies = skip_free_flight and not bodies
    first = free_flight_steps(model, regions, state, frames[-1], copies) if flies else 0
    more = {"F_total": state.F} if total else {}
    if model.contact == "particles":
        more["stuck"] = state.stuck
    start = (*state.motion, *more.values())
    in_flight = sum(n < first for n in frames)
    flight = ballistic(model, start, tuple(more), tracers, frames[:in_flight]) if in_flight else None
    frames = frames[in_flight:]
    if flight is not None and not frames:
        return of_laws(flight), [None] * copies
    if first:
        landed = ballistic(model, start, tuple(more), tracers, (first,))
        start = (landed.x[0], landed.v[0], *start[2:])
        tracers = None if landed.tracers is None else landed.tracers[0]
    x, steps, plan = state.x, frames[-1] - first, None
    scatter = scatter or scatter_for(x.device, x.dtype)
    weights, slices = gather_weights(regions, x.dtype)
    inputs = (*start, *weights)
    if torch.is_grad_enabled() and any(t.requires_grad for t in inputs):
        cache_bytes = DEFAULT_CACHE_BYTES[x.device.type] if cache_bytes is None else cache_bytes
        nodes, contact = copies * max(1, len(bodies)) * model.nodes**3, model.contact == "particles"
        rows = nodes // model.nodes if scatter == "native" else 0
        plan = plan_memory(
            steps, len(x), nodes, x.element_size(), cache_bytes, memory, total, contact, rows, bool(bodies)
        )
    simulation = Simulation(
        model, regions, slices, state, steps, first, plan, scatter, total, copies, frictions, ranges
    )
    passive = None if tracers is None else (tracers, tracer_bodies)
    *states, seen = RolloutFunction.apply(simulation, [n - first for n in frames], passive, *inputs)
    path = Trajectory(frames, *states[:4], tracers=seen, **dict(zip(more, states[4:], strict=True)))
    return of_laws(path if flight is None else flight.followed_by(path)), simulation.errors


class RolloutFunction(torch.autograd.Function):
    """All steps as one function of the initial state and the weights."""

    @staticmethod
    def forward(ctx, simulation, frames, passive, *inputs):
        count = len(simulation.workspace.states)
        start, weights = inputs[:count], inputs[count:]
        ctx.simulation, ctx.frames = simulation, frames
        ctx.set_materialize_grads(False)
        ctx.save_for_backward(*weights)
        result = simulation.run(start, weights, frames, *(passive or ()))
        if passive is not None:
            ctx.mark_non_differentiable(result[-1])
        return result

    @staticmethod
    @once_differentiable
    def backward(ctx, *grads):
        *grads, _ = grads  # tracers have no gradient
        start, weights = ctx.simulation.run_adjoint(ctx.saved_tensors, ctx.frames, grads)
        return None, None, None, *start, *weights


def checked_frames(frames: Sequence[int], steps: int) -> tuple[int, ...]:
    """The frames as a tuple of steps, strictly increasing from 0 to at most ``steps``."""
    frames = tuple(int(n) for n in frames)
    if not frames or frames[0] < 0 or any(b <= a for a, b in zip(frames, frames[1:], strict=False)):
        raise InputError("frames", f"{list(frames)} must be strictly increasing steps >= 0, at least one")
    if frames[-1] > steps:
        raise InputError("frames", f"the last frame, {frames[-1]}, must not exceed the {steps} steps")
    return frames


def check_bodies(model: MPM, state: State) -> None:
    """Raise InputError unless the bodies of a state can touch each other and the pairs of the model are among them."""
    if state.bodies and (model.contact != "particles" or model.clamps):
        given = "clamps" if model.clamps else f"contact of {model.contact}"
        problem = f"several bodies exclude {given}"
        raise InputError("state.bodies", problem, "Use contact of particles, no clamps")
    count = max(1, len(state.bodies))
    if any(pair.second >= count for pair in model.pairs):
        raise InputError("pairs", f"name a body that is none of the {count} of the state")


def check_inside(model: MPM, x0: Tensor) -> None:
    """Raise InputError unless the stencil of every particle exists."""
    low, high = model.stencil_range
    outside = ~((x0 >= low) & (x0 <= high)).all(dim=1)
    if outside.any():
        p = int(outside.nonzero()[0])
        place = ", ".join(f"{value:.4g}" for value in x0[p].tolist())
        raise InputError(
            "state.x",
            f"{int(outside.sum())} of {len(x0)} particles start outside the grid (first: {p}, at {place} m)",
            f"Place the object within [{low:.4g}, {high:.4g}] m on every axis",
        )
