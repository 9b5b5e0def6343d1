"""The loop over the steps and its adjoint: the only place where time advances.

A step turns the state (x, v, C, F) at t into that at t + dt (paper Sec. 3.2 and Algorithm 2):

    tau = elasticity(F);   P2G, grid, G2P;   F = plasticity((I + dt C) F)
"""

from __future__ import annotations

from collections.abc import Callable, Hashable, Sequence
from dataclasses import is_dataclass
from typing import Any

import torch
from torch import Tensor

from neuma_lib.errors import NonFiniteError
from neuma_lib.mechanics.law import Weights
from neuma_lib.sim.kernels import NEVER
from neuma_lib.sim.memory import plan_storage
from neuma_lib.sim.model import Body, MPMModel
from neuma_lib.sim.scatter import scatter_for
from neuma_lib.sim.workspace import Layout, Workspace, WorkspaceLease


class Simulation:
    """The loop over the steps, forward and in reverse, on a leased workspace.

    The steps are taken in segments. All states of a segment are in the workspace together if the rollout is to
    be differentiated; otherwise only the last one, and segments end at the frames. On a GPU a segment, there and
    back, is a CUDA graph, replayed from the third time on (`GraphCache`).

    Args:
        model, bodies: as in `rollout`.
        law_weights: weights of the elasticity and of the plasticity of each distinct law, by id(law). Only
            their order and number is used; values come with each call.
        like: a tensor of shape (N, 3) that gives count, precision and device.
        steps: number of steps.
        first: number of the first step, for messages.
        differentiable: store what `run_adjoint` needs.
        keep, memory: see `rollout`.
        scatter: how particles are added to nodes, one of `scatter.SCATTERS`; None takes the fastest.
    """

    def __init__(
        self,
        model: MPMModel,
        bodies: Sequence[Body],
        law_weights: dict[int, tuple[Weights, Weights]],
        like: Tensor,
        steps: int,
        first: int,
        differentiable: bool,
        keep: str,
        memory: float | None = None,
        scatter: str | None = None,
    ):
        self.model, self.bodies = model, bodies
        self.steps, self.first, self.differentiable = steps, first, differentiable
        self._weight_slices = _weight_slices(law_weights)
        on_gpu = like.device.type == "cuda"
        size = dict(steps=steps, particles=len(like), nodes=model.grid**3, itemsize=like.element_size())
        storage = plan_storage(**size, keep=keep, memory=memory if differentiable else None, on_gpu=on_gpu)
        self._segment = storage.segment
        self._keeps = differentiable and storage.keeps
        self._cache_bytes = storage.cache_bytes if self._keeps else 0
        self._cached: set[tuple[str, int, int]] = set()
        self._loaded = 0  # segment whose states are in the workspace
        self._lease = WorkspaceLease(
            Layout(
                model=model,
                particles=len(like),
                dtype=like.dtype,
                device=like.device,
                states=self._segment + 1 if differentiable else 2,
                kept=self._segment if self._keeps else 1,
                marks=-(-steps // self._segment) if differentiable and self._segment < steps else 0,
                differentiable=differentiable,
                scatter=scatter or scatter_for(like.device, like.dtype),
            )
        )
        parts = [getattr(body.law, part) for body in bodies for part in ("elasticity", "plasticity")]
        self._replays = on_gpu and all(part.capturable for part in parts)
        self._setup = tuple((b.start, b.stop) for b in bodies), tuple(part.graph_key() for part in parts)

    @property
    def workspace(self) -> Workspace:
        """Buffers of this simulation."""
        return self._lease.workspace

    def set_mass(self, mass: Tensor, vol0: Tensor) -> None:
        """Particle masses [kg] and initial volumes [m^3], shape (N,)."""
        self.workspace.mass.copy_(mass)
        self.workspace.vol0.copy_(vol0)

    def run(
        self,
        start: Sequence[Tensor],
        weights: Sequence[Tensor],
        frames: Sequence[int],
        tracers: Tensor | None = None,
    ) -> tuple[Tensor | None, ...]:
        """From the start (x, v, F, C) through all steps; x, v, F, C and tracers at the frames."""
        ws = self.workspace
        states = (ws.x, ws.v, ws.F, ws.C)
        result = tuple(value.new_empty(len(frames), *value.shape) for value in start)
        for state, value in zip(states, start, strict=True):
            state[0].copy_(value)
        if self._replays:
            ws.load_weights(weights)
            weights = ws.weights
        paths = None if tracers is None else _Paths(ws, tracers, frames)
        faults = [ws.faults.clone()]
        self._copy_frames(0, [0], frames, result)
        ended = 0
        for index, (first, steps) in enumerate(self._segments(frames)):
            if ended:
                for state in states:
                    state[0].copy_(state[ended])
            for mark, state in zip(ws.marks, states, strict=True):
                if len(mark):
                    mark[index].copy_(state[0])
            if paths is None:
                self._do(("forward", steps), lambda steps=steps: self._advance(steps, weights))
            else:
                self._advance(steps, weights, lambda n, first=first: paths.follow(n, first))
            ended, self._loaded = ws.state(steps), index
            self._copy_frames(first, range(1, steps + 1) if self.differentiable else [steps], frames, result)
            faults.append(torch.where(ws.faults < NEVER, ws.faults + (first << 31), ws.faults))
            ws.faults.fill_(NEVER)
        self._raise_faults(torch.stack(faults).amin(0), result[2][-1])
        return *result, None if paths is None else paths.seen

    def step(self, n: int, weights: Sequence[Tensor]) -> None:
        """State n to state n + 1."""
        ws = self.workspace
        ws.sort(n)
        self._evaluate("elasticity", n, ws.F[ws.state(n)], weights, ws.tau[ws.kept(n)])
        ws.transfer_to_grid(n)
        ws.transfer_to_particles(n)
        self._evaluate("plasticity", n, ws.F_trial[ws.kept(n)], weights, ws.F[ws.state(n + 1)])

    def run_adjoint(
        self, weights: Sequence[Tensor], frames: Sequence[int], grads: Sequence[Tensor | None]
    ) -> tuple[tuple[Tensor, ...], list[Tensor]]:
        """Gradients of x, v, F, C at the frames to those of the start (x, v, F, C) and of the weights."""
        ws = self.workspace
        if self._replays:
            weights, grad_weights = ws.weights, ws.grad_weights
        else:
            grad_weights = [torch.zeros_like(w) for w in weights]
        totals = (ws.grad_x, ws.grad_v, ws.grad_F, ws.grad_C)
        for total in (*totals, *grad_weights):
            total.zero_()
        for index, (first, steps) in reversed(list(enumerate(self._segments(frames)))):
            if index != self._loaded:
                for mark, state in zip(ws.marks, (ws.x, ws.v, ws.F, ws.C), strict=True):
                    state[0].copy_(mark[index])
                self._do(("forward", steps), lambda steps=steps: self._advance(steps, weights))
                self._loaded = index
            here = [f for f, n in enumerate(frames) if first < n <= first + steps]
            at = tuple(frames[f] - first for f in here)
            part = slice(here[0], here[-1] + 1) if here else slice(0)
            seeds = [None if grad is None else grad[part] for grad in grads]
            name = ("adjoint", steps, at, tuple(seed is not None for seed in seeds))
            if self._replays:
                seeds = ws.load_seeds(name, seeds)
            self._do(
                name,
                lambda steps=steps, at=at, seeds=seeds: self._go_back(
                    steps, at, seeds, weights, grad_weights
                ),
            )
        if frames[0] == 0:
            for total, grad in zip(totals, grads, strict=True):
                if grad is not None:
                    total.add_(grad[0])
        return tuple(total.clone() for total in totals), [grad.clone() for grad in grad_weights]

    def step_adjoint(self, n: int, weights: Sequence[Tensor], grad_weights: Sequence[Tensor]) -> None:
        """Gradients of state n + 1, in the workspace, to those of state n; those of the weights are added."""
        ws = self.workspace
        F, F_trial = ws.F[ws.state(n)], ws.F_trial[ws.kept(n)]
        if not self._keeps:
            self._evaluate("elasticity", n, F, weights, ws.tau[ws.kept(n)], cache=True)
            ws.transfer_to_grid(n)
            ws.trial_deformation(n)
        self._vjp("plasticity", n, F_trial, weights, ws.grad_F, ws.grad_F_trial, grad_weights)
        ws.transfer_adjoint(n)
        self._vjp("elasticity", n, F, weights, ws.grad_tau, ws.grad_F_elastic, grad_weights)
        ws.grad_F.add_(ws.grad_F_elastic)

    def _segments(self, frames: Sequence[int]) -> list[tuple[int, int]]:
        """First step and number of steps of each segment."""
        if self.differentiable:
            borders = [*range(0, self.steps, self._segment), self.steps]
        else:
            borders = sorted({0, *frames, self.steps})
        return [(a, b - a) for a, b in zip(borders, borders[1:], strict=False)]

    def _do(self, name: Hashable, launches: Callable[[], None]) -> None:
        """Launch, by a graph where these are used."""
        if self._replays:
            self.workspace.graphs.run((name, self._setup), launches)
        else:
            launches()

    def _advance(
        self, steps: int, weights: Sequence[Tensor], after_step: Callable[[int], None] | None = None
    ) -> None:
        """All steps of a segment."""
        with self.workspace.stream():
            for n in range(steps):
                self.step(n, weights)
                if after_step:
                    after_step(n)

    def _go_back(
        self,
        steps: int,
        at: Sequence[int],
        seeds: Sequence[Tensor | None],
        weights: Sequence[Tensor],
        grad_weights: Sequence[Tensor],
    ) -> None:
        """All steps of a segment in reverse, adding the seeds, gradients of the states after steps `at`."""
        ws = self.workspace
        totals = (ws.grad_x, ws.grad_v, ws.grad_F, ws.grad_C)
        frame_of = {n: index for index, n in enumerate(at)}
        ws.grad_grid.zero_()
        with ws.stream():
            for n in range(steps, 0, -1):
                if n in frame_of:
                    for total, seed in zip(totals, seeds, strict=True):
                        if seed is not None:
                            total.add_(seed[frame_of[n]])
                self.step_adjoint(n - 1, weights, grad_weights)

    def _copy_frames(
        self, first: int, steps: Sequence[int], frames: Sequence[int], result: Sequence[Tensor]
    ) -> None:
        """States after some steps of the segment that starts at step `first`, where they are frames."""
        ws = self.workspace
        frame_of = {n: index for index, n in enumerate(frames)}
        here = [(frame_of[first + n], ws.state(n)) for n in steps if first + n in frame_of]
        if here:
            part = slice(here[0][0], here[-1][0] + 1)
            slots = torch.tensor([slot for _, slot in here], device=ws.layout.device)
            for values, state in zip(result, (ws.x, ws.v, ws.F, ws.C), strict=True):
                torch.index_select(state, 0, slots, out=values[part])

    def _evaluate(
        self, part: str, n: int, F: Tensor, weights: Sequence[Tensor], out: Tensor, cache: bool = False
    ) -> None:
        """Elasticity or plasticity of every body; caches what the adjoint needs if asked to or if it fits."""
        for index, body in enumerate(self.bodies):
            here = slice(body.start, body.stop)
            law, own = getattr(body.law, part), self._own(part, body, weights)
            if cache or self._cache_bytes > 0:
                key = self._cache_key(part, n, body)
                caches = self.workspace.caches
                _, caches[key] = law.evaluate_with_cache(F[here], own, out[here], caches.get(key))
                self._cached.add((part, n, index))
                self._cache_bytes -= _bytes(caches[key])
            else:
                law.evaluate(F[here], own, out[here])

    def _vjp(
        self,
        part: str,
        n: int,
        F: Tensor,
        weights: Sequence[Tensor],
        grad_out: Tensor,
        grad_F: Tensor,
        grad_weights: Sequence[Tensor],
    ) -> None:
        """Adjoint of `_evaluate`; sets grad_F and adds to grad_weights."""
        for index, body in enumerate(self.bodies):
            here = slice(body.start, body.stop)
            cached = (part, n, index) in self._cached
            getattr(body.law, part).vjp(
                F[here],
                self._own(part, body, weights),
                grad_out[here],
                cache=self.workspace.caches[self._cache_key(part, n, body)] if cached else None,
                grad_F=grad_F[here],
                grad_weights=self._own(part, body, grad_weights),
            )

    def _cache_key(self, part: str, n: int, body: Body) -> tuple:
        """Name of a cache that any law of the same type and range of particles can use again."""
        return type(getattr(body.law, part)), body.start, body.stop, self.workspace.kept(n)

    def _own(self, part: str, body: Body, values: Sequence[Tensor]) -> Weights:
        """Those of the flat list of weights (or of their gradients) that belong to a part of a body's law."""
        return tuple(values[self._weight_slices[id(body.law), part]])

    def _raise_faults(self, faults: Tensor, F: Tensor) -> None:
        """Raise if a velocity on the way or the last F (N, 3, 3) is not what a stable simulation gives."""
        not_finite, too_fast = faults.tolist()
        if min(not_finite, too_fast) == NEVER and not torch.isfinite(F).all():
            particle = int((~torch.isfinite(F).flatten(1).all(dim=1)).nonzero()[0])
            not_finite = (self.steps - 1) << 31 | particle
        fault = min(not_finite, too_fast)
        if fault == NEVER:
            return
        step, particle = self.first + (fault >> 31) + 1, fault & (1 << 31) - 1
        law = next(body.law for body in self.bodies if body.start <= particle < body.stop)
        happened = "moved by more than a cell in a step" if too_fast < not_finite else "became non-finite"
        raise NonFiniteError(
            "rollout",
            f"particle {particle} (law {law.name!r}) {happened} at step {step}, t = "
            f"{step * self.model.dt:.4g} s: the simulation is unstable. Use a smaller dt (see "
            "MPMModel.check_courant), a slower start, or the last good weights with a lower rate",
            step=step,
            particle=particle,
        )


class _Paths:
    """Tracers (M, 3) on their way, and where they were at the frames, `seen` (T, M, 3)."""

    def __init__(self, ws: Workspace, tracers: Tensor, frames: Sequence[int]):
        self._ws, self._frame_of = ws, {n: index for index, n in enumerate(frames)}
        self._now = tracers.detach().clone(memory_format=torch.contiguous_format)
        self._launch = ws.tracer_launch(self._now)
        self.seen = self._now.new_empty(len(frames), *self._now.shape)
        self._look(0)

    def follow(self, n: int, first: int) -> None:
        """Move with the nodes of step n of the segment that starts at step `first`."""
        self._ws.move_tracers(self._launch, n)
        self._look(first + n + 1)

    def _look(self, step: int) -> None:
        if step in self._frame_of:
            self.seen[self._frame_of[step]].copy_(self._now)


def _weight_slices(law_weights: dict[int, tuple[Weights, Weights]]) -> dict[tuple[int, str], slice]:
    """Where the weights of each law's parts stand in the flat list."""
    slices, at = {}, 0
    for key, parts in law_weights.items():
        for name, part in zip(("elasticity", "plasticity"), parts, strict=True):
            slices[key, name] = slice(at, at + len(part))
            at += len(part)
    return slices


def _bytes(cache: Any) -> int:
    """Memory of the tensors in a law's cache."""
    if isinstance(cache, Tensor):
        return cache.numel() * cache.element_size()
    if is_dataclass(cache):
        cache = vars(cache).values()
    elif not isinstance(cache, (tuple, list)):
        return 0
    return sum(map(_bytes, cache))
