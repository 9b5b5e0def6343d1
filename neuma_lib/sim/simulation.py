"""The loop over the steps and its adjoint: the only place where time advances.

A step turns the state (x, v, C, F) at t into that at t + dt (paper Sec. 3.2 and Algorithm 2):

    tau = elasticity(F);   P2G, grid, G2P;   F = plasticity((I + dt C) F)
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import is_dataclass
from typing import Any

import torch
from torch import Tensor

from neuma_lib.errors import NonFiniteError
from neuma_lib.materials.base import Weights
from neuma_lib.sim.kernels import NEVER
from neuma_lib.sim.model import Body, MPMModel
from neuma_lib.sim.workspace import Layout, Workspace, WorkspaceLease

KEEP = {"auto": 1 << 29, "states": 0, "all": math.inf}
"""Bytes that a rollout may spend on intermediate values for its reverse loop, beyond the states."""


class Simulation:
    """The loop over the steps, forward and in reverse, on a leased workspace.

    Args:
        model, bodies: as in `rollout`.
        law_weights: weights of the elasticity and of the plasticity of each distinct law, by id(law). Only
            their order and number is used; values come with each call.
        like: a tensor of shape (N, 3) that gives count, precision and device.
        steps: number of steps.
        first: number of the first step, for messages.
        differentiable: store what `run_adjoint` needs.
        keep: see `rollout`.
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
    ):
        self.model, self.bodies = model, bodies
        self.steps, self.first = steps, first
        self._weight_slices = _weight_slices(law_weights)
        step_bytes = like.element_size() * (18 * len(like) + 8 * model.grid**3)  # tau, F_trial; grid, grid_v
        limit = KEEP[keep]
        self._keeps = differentiable and steps > 0 and step_bytes * steps <= limit
        self._cache_bytes = limit - step_bytes * steps if self._keeps else 0
        self._cached: set[tuple[str, int, int]] = set()
        self._lease = WorkspaceLease(
            Layout(
                model=model,
                particles=len(like),
                dtype=like.dtype,
                device=like.device,
                states=steps + 1 if differentiable else 2,
                kept=steps if self._keeps else 1,
                differentiable=differentiable,
            )
        )

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
        buffers = (ws.x, ws.v, ws.F, ws.C)
        for buffer, value in zip(buffers, start, strict=True):
            buffer[0].copy_(value)
        result = tuple(value.new_empty(len(frames), *value.shape) for value in start)
        moving = paths = launch = None
        if tracers is not None:
            moving = tracers.detach().clone(memory_format=torch.contiguous_format)
            paths = moving.new_empty(len(frames), *moving.shape)
            launch = ws.tracer_launch(moving)
        frame_of = {step: frame for frame, step in enumerate(frames)}
        with ws.stream():
            for step in range(self.steps + 1):
                if step in frame_of:
                    for buffer, values in zip(buffers, result, strict=True):
                        values[frame_of[step]].copy_(buffer[ws.state(step)])
                    if tracers is not None:
                        paths[frame_of[step]].copy_(moving)
                if step < self.steps:
                    self.step(step, weights)
                    if tracers is not None:
                        ws.move_tracers(launch, step)
        self._raise_faults(result[2][-1])
        return *result, paths

    def step(self, n: int, weights: Sequence[Tensor]) -> None:
        """State n to state n + 1."""
        ws = self.workspace
        self._evaluate("elasticity", n, ws.F[ws.state(n)], weights, ws.tau[ws.kept(n)])
        ws.transfer_to_grid(n)
        ws.transfer_to_particles(n)
        self._evaluate("plasticity", n, ws.F_trial[ws.kept(n)], weights, ws.F[ws.state(n + 1)])

    def run_adjoint(
        self, weights: Sequence[Tensor], frames: Sequence[int], grads: Sequence[Tensor | None]
    ) -> tuple[tuple[Tensor, ...], list[Tensor]]:
        """Gradients of x, v, F, C at the frames to those of the start (x, v, F, C) and of the weights."""
        ws = self.workspace
        buffers = (ws.grad_x, ws.grad_v, ws.grad_F, ws.grad_C)
        for buffer in buffers:
            buffer.zero_()
        grad_weights = [torch.zeros_like(w) for w in weights]
        frame_of = {step: frame for frame, step in enumerate(frames)}
        with ws.stream():
            for step in range(self.steps, -1, -1):
                if step in frame_of:
                    for buffer, grad in zip(buffers, grads, strict=True):
                        if grad is not None:
                            buffer.add_(grad[frame_of[step]])
                if step > 0:
                    self.step_adjoint(step - 1, weights, grad_weights)
        return tuple(buffer.clone() for buffer in buffers), grad_weights

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

    def _raise_faults(self, F: Tensor) -> None:
        """Raise if a velocity on the way or the last F (N, 3, 3) is not what a stable simulation gives."""
        not_finite, too_fast = self.workspace.faults.tolist()
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
