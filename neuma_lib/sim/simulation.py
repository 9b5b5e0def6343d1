"""The loop over time steps and its adjoint.

A step maps the state (x, v, C, F) at t to that at t + dt (paper Sec. 3.2 and Algorithm 2):

    tau = elasticity(F);   P2G, grid, G2P;   F = plasticity((I + dt C) F)

The state may include the total deformation, elastic and plastic: F_total = (I + dt C) F_total.
"""

from collections.abc import Callable, Hashable, Mapping, Sequence
from dataclasses import is_dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from neuma_lib.errors import NonFiniteError
from neuma_lib.mechanics.law import Constitutive, Weights
from neuma_lib.sim.clamps import clamped_particles
from neuma_lib.sim.kernels import NO_FAULT
from neuma_lib.sim.memory import MemoryPlan
from neuma_lib.sim.model import MPM, MaterialRegion, law_weights
from neuma_lib.sim.scatter import scatter_for
from neuma_lib.sim.segment_loop import SegmentLoop, segment_loop
from neuma_lib.sim.sequence import Repeated
from neuma_lib.sim.state import State
from neuma_lib.sim.workspace import Workspace, WorkspaceSize, pooled_workspace

PARTS = ("elasticity", "plasticity")


def gather_weights(
    regions: Sequence[MaterialRegion], dtype: torch.dtype
) -> tuple[list[Tensor], dict[tuple[int, str], slice]]:
    """Weights of all laws in one list, and the slice of each part by (id(law), part)."""
    weights, slices = [], {}
    for law in {id(region.law): region.law for region in regions}.values():
        for part, own in zip(PARTS, law_weights(law, dtype), strict=True):
            slices[id(law), part] = slice(len(weights), len(weights) + len(own))
            weights += own
    return weights, slices


class Simulation:
    """The loop over the steps, forward and in reverse, with buffers that it owns during its lifetime.

    Steps are grouped in segments. For a differentiable rollout all states of a segment are in memory. Otherwise only
    the last one is, and segments end at the frames. On a GPU a segment in one direction is a CUDA graph (`GraphCache`).

    Args:
        model, regions: see `rollout`.
        weight_slices: second result of `gather_weights`; the weights are an argument of each call.
        state: number of particles, masses and volumes, precision and device.
        steps: number of steps.
        first: number of the first step, for messages.
        plan: memory plan for `run_adjoint`, or None if that is not called.
        scatter: scatter method, see `scatter`. None chooses the fastest.
        total: whether the state includes the total deformation.
        copies: number of independent simulations in the state that share launches, see `kernels`.
        frictions: `MPM.frictions` of each copy. None: those of the model.
        ranges: consecutive ranges of a copy, with their numbers of particles and their bodies, if there are several.

    Attributes:
        errors: after `run`, the error of each copy, or None.
    """

    def __init__(
        self,
        model: MPM,
        regions: Sequence[MaterialRegion],
        weight_slices: dict[tuple[int, str], slice],
        state: State,
        steps: int,
        first: int = 0,
        plan: MemoryPlan | None = None,
        scatter: str | None = None,
        total: bool = False,
        copies: int = 1,
        frictions: Sequence[Sequence[float]] | None = None,
        ranges: tuple[tuple[int, int], ...] = (),
    ):
        self.model, self.regions, self.steps, self.first, self.plan = model, regions, steps, first, plan
        x = state.x
        scatter = scatter or scatter_for(x.device, x.dtype)
        # Models that differ only in friction share workspaces.
        size = WorkspaceSize(
            model.frictionless,
            len(x),
            x.dtype,
            x.device,
            total=total,
            copies=copies,
            scatter=scatter,
            ranges=ranges,
        )
        if model.changes:
            size = size._replace(n_poses=steps + 1)
        if plan:
            size = size._replace(
                n_states=plan.segment + 1,
                n_cached_steps=plan.segment if plan.caches_steps else 1,
                n_checkpoints=-(-steps // plan.segment) if plan.segment < steps else 0,
                differentiable=True,
            )
        self.workspace = pooled_workspace(size, user=self)
        frictions = frictions or [model.frictions] * copies
        stiffness = 1.0 if state.stiffness is None else state.stiffness.detach()
        particles = state.mass.detach(), state.vol0.detach()
        self.workspace.load_particles(*particles, np.array(frictions), stiffness)
        if model.clamps:
            clamp = clamped_particles(model.clamps, state.x.detach()) if state.clamp is None else state.clamp
            self.workspace.clamp.copy_(clamp)
        self._law_cache_bytes = plan.law_cache_bytes if plan else 0
        self._cached: set[tuple] = set()  # evaluations of laws with valid caches
        self._segment_in_memory = 0
        self._weight_slices = weight_slices
        laws = [getattr(region.law, part) for region in regions for part in PARTS]
        single = x.dtype == torch.float32  # float64 on a GPU is for comparisons only
        self._uses_graphs = x.device.type == "cuda" and single and all(law.capturable for law in laws)
        # No kernel adds the gradient of an analytic stress to that of another kind of return map.
        added = all(r.law.plasticity.native_rows or not r.law.elasticity.native_rows for r in regions)
        self._loops = bool(self.workspace.native) and added and all(law.loops for law in laws)
        self._loop: SegmentLoop | None = None
        self.errors: list[NonFiniteError | None] = [None] * copies
        self._graph_key = tuple((b.start, b.stop) for b in regions), tuple(law.graph_key() for law in laws)

    def run(
        self,
        start: Sequence[Tensor],
        weights: Sequence[Tensor],
        frames: Sequence[int],
        tracers: Tensor | None = None,
        tracer_bodies: Sequence[int] = (),
    ) -> tuple[Tensor | None, ...]:
        """Run all steps from ``start`` (`Workspace.states`) and return these and tracers at the frames.

        ``tracer_bodies`` has the number of tracers of each body, if there are several.

        Raises:
            NonFiniteError: every copy diverged. If only some did, `errors` has their errors.
        """
        ws = self.workspace
        states = ws.states
        result = tuple(value.new_empty(len(frames), *value.shape) for value in start)
        for state, value in zip(states, start, strict=True):
            state[0].copy_(value)
        if self._uses_graphs or self._loops:
            ws.load_weights(weights)
            weights = ws.weights
        passive = None if tracers is None else _Tracers(ws, tracers, tracer_bodies, frames)
        self._make_loop(weights, None if passive is None else passive.repeated)
        faults = ws.faults.clone()
        self._copy_frames(0, [0], frames, result)
        last, previous = 0, None  # index of the last state of the previous segment, and its number of steps
        for index, (first, steps) in enumerate(self._segments(frames)):
            for state in states if last else ():
                state[0].copy_(state[last])
            for checkpoint, state in zip(ws.checkpoints, ws.states, strict=True):
                if len(checkpoint):
                    from_loop = self._loop and state is ws.F
                    checkpoint[index].copy_(self._loop.before(previous) if from_loop else state[0])
            if self._loop:
                self._loop.start(previous)
            ws.load_poses(self.first + first, steps)
            if passive is None:
                self._launch(("forward", steps), lambda steps=steps: self._advance(steps, weights))
            else:
                self._advance(steps, weights, passive, first)
            last, previous, self._segment_in_memory = ws.at(steps), steps, index
            self._copy_frames(first, range(1, steps + 1) if self.plan else [steps], frames, result)
            shifted = torch.where(ws.faults < NO_FAULT, ws.faults + (first << 31), ws.faults)
            torch.minimum(faults, shifted, out=faults)
            ws.faults.fill_(NO_FAULT)
            # This check would synchronise a GPU.
            if ws.size.device.type == "cpu" and (faults < NO_FAULT).any(dim=1).all():
                break
        if passive is not None:
            self._make_loop(weights, None)  # segments that are computed again do not move them
        self._find_errors(faults, result[2][-1])
        return *result, None if passive is None else passive.seen

    def step(self, n: int, weights: Sequence[Tensor]) -> None:
        """State n to state n + 1."""
        ws = self.workspace
        cached = ws.cached_at(n)
        ws.sort(n)
        self._evaluate("elasticity", n, ws.F[ws.at(n)], weights, ws.tau[ws.stress_at(n)])
        ws.transfer_to_grid(n)
        ws.transfer_to_particles(n)
        self._evaluate("plasticity", n, ws.F_trial[cached], weights, ws.F[ws.at(n + 1)])

    def run_adjoint(
        self, weights: Sequence[Tensor], frames: Sequence[int], grads: Sequence[Tensor | None]
    ) -> tuple[tuple[Tensor, ...], list[Tensor]]:
        """From gradients of the states at the frames to those of the initial state and of the weights."""
        ws = self.workspace
        if self._uses_graphs or self._loops:
            weights, grad_weights = ws.weights, ws.grad_weights
        else:
            grad_weights = [torch.zeros_like(w) for w in weights]
        totals = ws.grad_states
        for total in (*totals, *grad_weights, ws.grad_tau):
            total.zero_()
        for index, (first, steps) in reversed(list(enumerate(self._segments(frames)))):
            ws.load_poses(self.first + first, steps)
            if index != self._segment_in_memory:
                for checkpoint, state in zip(ws.checkpoints, ws.states, strict=True):
                    state[0].copy_(checkpoint[index])
                if self._loop:
                    self._loop.restart(self._before(index))
                self._launch(("forward", steps), lambda steps=steps: self._advance(steps, weights))
                self._segment_in_memory = index
            here = [f for f, n in enumerate(frames) if first < n <= first + steps]
            at = tuple(frames[f] - first for f in here)
            part = slice(here[0], here[-1] + 1) if here else slice(0)
            added = [None if grad is None else grad[part] for grad in grads]
            name = ("adjoint", steps, at, tuple(grad is not None for grad in added))
            if self._uses_graphs:
                added = ws.load_frame_grads(name, added)
            self._launch(
                name,
                lambda steps=steps, at=at, added=added, index=index: self._reverse(
                    index, steps, at, added, weights, grad_weights
                ),
            )
        if frames[0] == 0:
            for total, grad in zip(totals, grads, strict=True):
                if grad is not None:
                    total.add_(grad[0])
        return tuple(total.clone() for total in totals), [grad.clone() for grad in grad_weights]

    def step_adjoint(self, n: int, weights: Sequence[Tensor], sums: Mapping[str, Sequence[Weights]]) -> None:
        """From gradients of state n + 1, in the workspace, to those of state n, whose grad_F lacks grad_F_elastic.

        Gradients of the weights are added to `sums`, the `Constitutive.accumulators` of all regions by part of the law.
        """
        ws = self.workspace
        cached = ws.cached_at(n)
        F, F_trial = ws.F[ws.at(n)], ws.F_trial[cached]
        if not self.plan.caches_steps:
            self._evaluate("elasticity", n, F, weights, ws.tau[ws.stress_at(n)], fill_cache=True)
            ws.trial_deformation(n)
        if not self.plan.caches_steps or ws.native:
            ws.transfer_to_grid(n, again=True)
        self._vjp("plasticity", n, F_trial, weights, ws.grad_F, ws.grad_F_trial, sums)
        ws.transfer_adjoint(n)
        self._vjp("elasticity", n, F, weights, ws.grad_tau, ws.grad_F_elastic, sums)

    def _segments(self, frames: Sequence[int]) -> list[tuple[int, int]]:
        """First step and number of steps of each segment."""
        if self.plan:
            borders = [*range(0, self.steps, self.plan.segment), self.steps]
        else:
            borders = sorted({0, *frames, self.steps})
        return [(a, b - a) for a, b in zip(borders, borders[1:], strict=False)]

    def _launch(self, name: Hashable, launches: Callable[[], None]) -> None:
        """Run launches, as a graph if graphs are used."""
        if self._uses_graphs:
            self.workspace.graphs.run((name, self._graph_key), launches)
        else:
            launches()

    def _make_loop(self, weights: Sequence[Tensor], tracers: Repeated | None) -> None:
        """Build the loop over the steps of a segment if all laws have kernels on a CPU."""
        if self._loops:
            parts = {
                part: [(law, here, tuple(weights[own])) for law, here, own, _ in self._laws(part, 0)]
                for part in PARTS
            }
            caches_steps = self.plan is not None and self.plan.caches_steps
            self._loop = segment_loop(self.workspace, parts, caches_steps, self._law_cache_bytes, tracers)

    def _advance(
        self, steps: int, weights: Sequence[Tensor], passive: "_Tracers | None" = None, first: int = 0
    ) -> None:
        """Run all steps of a segment, which starts at step `first`, and move the tracers."""
        if self._loop:
            stops = [*(n - first for n in passive.frames_after(first, steps)), steps] if passive else [steps]
            n = 0
            for stop in stops:
                self._loop.advance(n, stop - n)
                n = stop
                if passive:
                    passive.store(first + n)
            return
        with self.workspace.stream():
            self.workspace.start_segment()
            for n in range(steps):
                self.step(n, weights)
                if passive:
                    passive.move(n)
                    passive.store(first + n + 1)

    def _before(self, index: int) -> Tensor | None:
        """F_trial before a segment, or None if it is the first."""
        return self.workspace.checkpoints[2][index] if index else None

    def _reverse(
        self,
        index: int,
        steps: int,
        at: Sequence[int],
        added: Sequence[Tensor | None],
        weights: Sequence[Tensor],
        grad_weights: Sequence[Tensor],
    ) -> None:
        """Run the adjoint of all steps of a segment and add the gradients of the states after the steps `at`."""
        ws = self.workspace
        totals = ws.grad_states
        frame_of = {n: index for index, n in enumerate(at)}
        if not ws.native:
            ws.grad_grid.zero_()
        with ws.stream():
            sums = {
                part: [
                    law.accumulators(ws.grad_F[here], tuple(grad_weights[own]))
                    for law, here, own, _ in self._laws(part, 0)
                ]
                for part in PARTS
            }
            if self._loop:
                self._loop.start_reverse(steps, self._before(index))
            else:
                add = ws.gradient_sum(added)
            n = steps
            while n > 0:
                if n in frame_of and (self._loop or n == steps):
                    for total, grad in zip(totals, added, strict=True):
                        if grad is not None:
                            total.add_(grad[frame_of[n]])
                before = max([m for m in at if m < n], default=0) if self._loop else n - 1
                if self._loop:
                    self._loop.reverse(n - 1, n - before)
                else:
                    self.step_adjoint(before, weights, sums)
                    add(frame_of.get(before, -1))
                n = before
            if self._loop and index == 0:
                self._loop.end()
            for part in PARTS:
                if self._loop and index == 0:
                    self._loop.end_reverse(part, sums[part])
                for (law, _, own, _), received in zip(self._laws(part, 0), sums[part], strict=True):
                    law.add_up(received, tuple(weights[own]), tuple(grad_weights[own]))

    def _copy_frames(
        self, first: int, steps: Sequence[int], frames: Sequence[int], result: Sequence[Tensor]
    ) -> None:
        """Copy states after ``steps`` of the segment that starts at step `first` to ``result`` if they are frames."""
        ws = self.workspace
        frame_of = {n: index for index, n in enumerate(frames)}
        here = [(frame_of[first + n], ws.at(n)) for n in steps if first + n in frame_of]
        if here:
            part = slice(here[0][0], here[-1][0] + 1)
            indices = torch.tensor([index for _, index in here], device=ws.size.device)
            for values, state in zip(result, ws.states, strict=True):
                torch.index_select(state, 0, indices, out=values[part])

    def _evaluate(
        self, part: str, n: int, F: Tensor, weights: Sequence[Tensor], out: Tensor, fill_cache: bool = False
    ) -> None:
        """Evaluate elasticity or plasticity of every region, with a cache for `_vjp` if requested or if it fits."""
        for law, here, own, key in self._laws(part, n):
            if fill_cache or self._law_cache_bytes > 0:
                caches = self.workspace.law_caches
                _, caches[key] = law.evaluate_with_cache(
                    F[here], tuple(weights[own]), out[here], caches.get(key)
                )
                self._cached.add(key)
                self._law_cache_bytes -= _bytes(caches[key])
            else:
                law.evaluate(F[here], tuple(weights[own]), out[here])

    def _vjp(
        self,
        part: str,
        n: int,
        F: Tensor,
        weights: Sequence[Tensor],
        grad_out: Tensor,
        grad_F: Tensor,
        sums: Mapping[str, Sequence[Weights]],
    ) -> None:
        """Adjoint of `_evaluate`. Sets grad_F and adds to the sums."""
        for (law, here, own, key), received in zip(self._laws(part, n), sums[part], strict=True):
            law.vjp(
                F[here],
                tuple(weights[own]),
                grad_out[here],
                cache=self.workspace.law_caches[key] if key in self._cached else None,
                grad_F=grad_F[here],
                grad_weights=received,
            )

    def _laws(self, part: str, n: int) -> list[tuple[Constitutive, slice, slice, tuple]]:
        """For every region: law, slice of particles, slice of weights, and key of the cache in step n.

        Laws of the same type with the same particles can reuse a cache.
        """
        laws = []
        for region in self.regions:
            law = getattr(region.law, part)
            key = (type(law), region.start, region.stop, self.workspace.cached_at(n))
            laws.append(
                (law, slice(region.start, region.stop), self._weight_slices[id(region.law), part], key)
            )
        return laws

    def _find_errors(self, faults: Tensor, F: Tensor) -> None:
        """Set `errors` from the fault flags and the last F (N, 3, 3), and raise the first if all copies failed."""
        self.errors = []
        for copy, (flags, own) in enumerate(zip(faults.tolist(), F.chunk(len(faults)), strict=True)):
            if min(flags) == NO_FAULT and not torch.isfinite(own).all():
                particle = int((~torch.isfinite(own).flatten(1).all(dim=1)).nonzero()[0])
                flags[0] = (self.steps - 1) << 31 | copy * len(own) + particle
            self.errors.append(self._error(*flags))
        if any(self.errors):
            self.workspace.clear_grids()
        if all(self.errors):
            raise self.errors[0]

    def _error(self, not_finite: int, too_fast: int, left: int) -> NonFiniteError | None:
        """The error described by the flags of a copy."""
        fault = min(not_finite, too_fast, left)
        if fault == NO_FAULT:
            return None
        step, particle = self.first + (fault >> 31) + 1, fault & (1 << 31) - 1
        law = next(region.law for region in self.regions if region.start <= particle < region.stop)
        happened = {
            not_finite: "became non-finite",
            too_fast: "moved by more than a cell in a step",
            left: "left the grid",
        }[fault]
        size = self.workspace.size
        particle %= size.particles // size.copies  # index within the copy
        return NonFiniteError(
            "rollout",
            f"particle {particle} (law {law.name!r}) {happened} at step {step}, t = "
            f"{step * self.model.dt:.4g} s: the simulation is unstable. Use a smaller dt (see "
            "MPM.check_courant), a slower start, or the last good weights with a lower rate",
            step=step,
            particle=particle,
            happened=happened,
        )


class _Tracers:
    """Passive points (M, 3) that move with the grid, and their positions at the frames, `seen` (T, M, 3)."""

    def __init__(self, ws: Workspace, tracers: Tensor, bodies: Sequence[int], frames: Sequence[int]):
        self._ws, self._frame_of = ws, {n: index for index, n in enumerate(frames)}
        self._x = tracers.detach().clone(memory_format=torch.contiguous_format)
        self._launch = ws.tracer_launch(self._x, bodies or (len(tracers),))
        self.repeated = Repeated(self._launch)
        self.seen = self._x.new_empty(len(frames), *self._x.shape)
        self.store(0)

    def move(self, n: int) -> None:
        """Move with the nodes of step n of the segment."""
        self._ws.move_tracers(self._launch, n)

    def frames_after(self, first: int, steps: int) -> list[int]:
        """Frames inside the segment of some steps from `first` on."""
        return [n for n in self._frame_of if first < n < first + steps]

    def store(self, step: int) -> None:
        """Keep the positions after a step if it is a frame."""
        if step in self._frame_of:
            self.seen[self._frame_of[step]].copy_(self._x)


def _bytes(cache: Any) -> int:
    """Memory of the tensors in a law's cache."""
    if isinstance(cache, Tensor):
        return cache.numel() * cache.element_size()
    if is_dataclass(cache):
        cache = vars(cache).values()
    elif not isinstance(cache, (tuple, list)):
        return 0
    return sum(map(_bytes, cache))
