"""The one entry to the simulator, for ground truth, velocity estimation, training and evaluation alike.

Callers differ in law, start and set of frames only. The gradient is one reverse loop over the stored states,
not a graph of steps: autograd sees one function from (x, v, F, C, weights of the laws) to the frames.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from neuma_lib.errors import InputError
from neuma_lib.mechanics.law import Law
from neuma_lib.sim.free_flight import ballistic, free_flight_steps
from neuma_lib.sim.memory import KEEP
from neuma_lib.sim.model import Body, MPMModel, as_bodies, law_weights
from neuma_lib.sim.simulation import Simulation
from neuma_lib.sim.state import State, Trajectory


def rollout(
    model: MPMModel,
    law: Law | Sequence[Body],
    state: State,
    *,
    steps: int,
    frames: Sequence[int],
    tracers: Tensor | None = None,
    skip_free_flight: bool = True,
    keep: str = "auto",
    memory: float | None = None,
    scatter: str | None = None,
) -> Trajectory:
    """Simulate particles and return their states at the frames.

    Differentiable with respect to the weights of the laws and to x, v, F and C of the state; masses, volumes and
    tracers carry no gradient.

    Args:
        model: grid, time step, gravity and walls.
        law: material of all particles, or bodies that each have a law and a range of particles on one grid.
        state: N particles at the start.
        steps: number of time steps; the simulation ends at the last frame, which must not lie beyond.
        frames: steps whose states are returned, strictly increasing, 0 is the start.
        tracers: positions of passive points that follow the grid's velocity [m], shape (M, 3).
        skip_free_flight: take the steps before the first contact in closed form while the state is undeformed
            and moves with one velocity: equal to simulating them, to round-off, in value and gradient. Not
            used where a gradient could deform the state (v of shape (N, 3), F or C that require it).
        keep: what the gradient keeps a step: "states" (x, v, C, F; the rest is computed again), "all", or
            "auto", which also keeps what fits a fixed amount of memory. Same gradient, other speed.
        memory: most bytes that the gradient may keep; where that is too little for the states of all steps, these
            are computed a second time, segment by segment. None: no limit. Same gradient, slower.
        scatter: how particles are added to nodes, see `scatter.SCATTERS`; None takes the fastest way.

    Raises:
        InputError: frames, tracers, a particle that starts outside the grid, bodies that misfit.
        NonFiniteError: a particle became non-finite or crossed a cell in a step; has `step` and `particle`.
    """
    frames = _checked_frames(frames, steps)
    bodies = as_bodies(law, len(state.x))
    _check_inside(model, state.x)
    if tracers is not None and (tracers.ndim != 2 or tracers.shape[1] != 3 or tracers.dtype != state.x.dtype):
        raise InputError(f"tracers: give positions of shape (M, 3) as {state.x.dtype}")
    if keep not in KEEP:
        raise InputError(f"keep = {keep!r}: choose one of {', '.join(KEEP)}")

    flight = free_flight_steps(model, bodies, state, frames[-1]) if skip_free_flight else 0
    start = state.motion
    seen = sum(n < flight for n in frames)
    parts = []
    if seen:
        parts.append(ballistic(model, start, tracers, frames[:seen]))
    if seen < len(frames):
        if flight:
            landed = ballistic(model, start, tracers, (flight,))
            start = (landed.x[0], landed.v[0], start[2], start[3])
            tracers = None if tracers is None else landed.tracers[0]
        parts.append(
            _simulate(
                model,
                bodies,
                start,
                state.mass,
                state.vol0,
                tracers,
                flight,
                frames[seen:],
                keep,
                memory,
                scatter,
            )
        )
    return parts[0] if len(parts) == 1 else _joined(*parts)


def _simulate(
    model: MPMModel,
    bodies: tuple[Body, ...],
    start: tuple[Tensor, ...],
    mass: Tensor,
    vol0: Tensor,
    tracers: Tensor | None,
    first: int,
    frames: tuple[int, ...],
    keep: str,
    memory: float | None,
    scatter: str | None,
) -> Trajectory:
    """Step from the state `start` at step `first` to the last frame."""
    laws = {id(body.law): body.law for body in bodies}
    weights = {key: law_weights(law, start[0].dtype) for key, law in laws.items()}
    flat = [w for elastic, plastic in weights.values() for w in (*elastic, *plastic)]
    inputs = (*start, *flat)
    differentiable = torch.is_grad_enabled() and any(t.requires_grad for t in inputs)
    steps = frames[-1] - first
    simulation = Simulation(
        model, bodies, weights, start[0], steps, first, differentiable, keep, memory, scatter
    )
    simulation.set_mass(mass, vol0)
    path = RolloutFunction.apply(simulation, [n - first for n in frames], tracers, *inputs)
    return Trajectory(frames, *path)


class RolloutFunction(torch.autograd.Function):
    """All steps as one function of the start and the weights."""

    @staticmethod
    def forward(ctx, simulation, frames, tracers, x0, v0, F0, C0, *weights):
        ctx.simulation, ctx.frames = simulation, frames
        ctx.set_materialize_grads(False)
        ctx.save_for_backward(*weights)
        result = simulation.run((x0, v0, F0, C0), weights, frames, tracers)
        if tracers is not None:
            ctx.mark_non_differentiable(result[-1])
        return result

    @staticmethod
    @once_differentiable
    def backward(ctx, grad_x, grad_v, grad_F, grad_C, _):
        grads = (grad_x, grad_v, grad_F, grad_C)
        start, weights = ctx.simulation.run_adjoint(ctx.saved_tensors, ctx.frames, grads)
        return None, None, None, *start, *weights


def _joined(first: Trajectory, second: Trajectory) -> Trajectory:
    """One trajectory after the other."""
    joined = {
        name: torch.cat([getattr(first, name), getattr(second, name)])
        for name in ("x", "v", "F", "C", "tracers")
        if getattr(first, name) is not None
    }
    return Trajectory(first.frames + second.frames, **joined)


def _checked_frames(frames: Sequence[int], steps: int) -> tuple[int, ...]:
    frames = tuple(int(n) for n in frames)
    if not frames or frames[0] < 0 or any(b <= a for a, b in zip(frames, frames[1:], strict=False)):
        raise InputError(f"frames = {list(frames)}: give at least one step, from 0 on, strictly increasing")
    if frames[-1] > steps:
        raise InputError(f"frames end at step {frames[-1]}, but the rollout has {steps} steps")
    return frames


def _check_inside(model: MPMModel, x0: Tensor) -> None:
    """Every particle must see three nodes along each axis."""
    low, high = model.stencil_range
    outside = ~((x0 >= low) & (x0 <= high)).all(dim=1)
    if outside.any():
        p = int(outside.nonzero()[0])
        place = ", ".join(f"{value:.4g}" for value in x0[p].tolist())
        raise InputError(
            f"{int(outside.sum())} of {len(x0)} particles start outside the grid (first: {p}, at {place} m): place "
            f"the object within [{low:.4g}, {high:.4g}] m on every axis"
        )
