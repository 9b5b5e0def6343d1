"""The steps of a segment in one call on a CPU, if all laws have kernels (`Constitutive.kernel_rows`).

Other laws run in Python between the transfers, step by step (`Simulation.step`).
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from functools import cache

import torch
import warp as wp
from torch import Tensor

from neuma_lib.mechanics import analytic_kernels
from neuma_lib.mechanics.law import Constitutive, Weights
from neuma_lib.sim.sequence import Index, LaunchSequence, Repeated
from neuma_lib.sim.workspace import Workspace

PARTICLE_STEPS = 1_000_000
"""Particles times steps in one call, which takes up to 0.3 s on a slow core. Signals wait for its end."""

Parts = Mapping[str, Sequence[tuple[Constitutive, slice, Weights]]]
"""For elasticity and plasticity: law, particles and weights of each region."""


class SegmentLoop:
    """Forward and reverse loops over the steps of a segment.

    If a region has a return map, the stress of a step is computed at the end of the previous one, because both need the
    same singular vectors. Only the first stress of a simulation is computed from F alone. For the same bytes, a
    segment is therefore recomputed from the F_trial before its first F.

    Args:
        ws: the buffers.
        parts: laws with kernels.
        caches_steps: whether the workspace keeps tau and F_trial of all steps.
        cache_bytes: memory for singular values, which are kept for a region if those of all steps fit.
        tracers: a launch that moves tracers after each step.
    """

    def __init__(
        self,
        ws: Workspace,
        parts: Parts,
        caches_steps: bool,
        cache_bytes: float,
        tracers: Repeated | None = None,
    ):
        self._ws, self._parts, self._caches_steps = ws, parts, caches_steps
        self._rows = {
            (part, k): law.kernel_rows(ws.F, weights)
            for part, regions in parts.items()
            for k, (law, _, weights) in enumerate(regions)
        }
        self._regions = range(len(parts["elasticity"]))
        self._elastic = all(law.identity for law, _, _ in parts["plasticity"])
        self._caches = self._new_caches(cache_bytes) if ws.size.differentiable else {}
        self._per_call = max(1, PARTICLE_STEPS // ws.size.particles)
        self._partials: dict[tuple[str, int], Tensor] = {}  # of the steps of a call
        self._grad_rows: dict[tuple[str, int], Tensor] = {}
        after = () if tracers is None else (tracers,)
        before, flow = (self._stresses(), []) if self._elastic else ([], self._flows())
        self._forward = LaunchSequence(
            [*before, *ws.native.to_grid, *ws.native.to_particles[self._elastic], *flow, *after]
        )
        self._stress, self._flow = LaunchSequence(self._stresses()), LaunchSequence(flow)
        self._reverse: LaunchSequence | None = None

    def start(self, steps: int | None) -> None:
        """Set the first stress of a segment after one of some steps, or the first of the simulation."""
        if not self._elastic and steps is None:
            self._stress.run(0)
        elif not self._elastic:
            self._ws.tau[0].copy_(self._ws.tau[self._ws.stress_at(steps)])

    def before(self, steps: int | None) -> Tensor:
        """Value from which `restart` computes the first F of a segment: F_trial if the loop returns, else F."""
        ws = self._ws
        return ws.F[0] if self._elastic or steps is None else ws.F_trial[ws.cached_at(steps - 1)]

    def restart(self, before: Tensor | None) -> None:
        """Set the first F and stress of a segment from the result of `before`, None for the first segment."""
        ws = self._ws
        if self._elastic or before is None:
            self.start(None)
            return
        ws.F_trial[0].copy_(before)
        self._flow.run(ws.size.n_states * ws.size.n_stresses - 1)  # writes to the first places

    def advance(self, first: int, steps: int) -> None:
        """Run steps from ``first`` on."""
        for n in range(first, first + steps, self._per_call):
            self._forward.run(n, min(self._per_call, first + steps - n))

    def start_reverse(self, steps: int, before: Tensor | None) -> None:
        """Prepare the reverse loop of a segment of some steps, after `restart` with the same value and `advance`."""
        if self._reverse is None:
            self._record_reverse()
        for total in self._grad_rows.values():
            total.zero_()
        self._before = before
        if not (self._elastic or self._caches_steps):
            self._again.run(steps - 1)

    def reverse(self, last: int, steps: int) -> None:
        """Run the adjoints of steps from ``last`` down."""
        stop = last - steps
        if stop < 0 and not (self._elastic or self._caches_steps):
            self._reverse_all(last, 0)
            self._adjoint_flow.run(0)
            self.restart(self._before)
            self._adjoint_rest.run(0)
            self._add_partials()
        else:
            self._reverse_all(last, stop)

    def end_reverse(self) -> None:
        """Add the part through the first stress of a simulation to the gradient of its F."""
        if not self._elastic:
            self._adjoint_stress.run(0)
            self._add_partials()

    def grad_rows(self, part: str, k: int) -> Tensor:
        """Gradient of the constants of a region's law, summed over the steps since `start_reverse`."""
        return self._grad_rows[part, k]

    def _reverse_all(self, last: int, stop: int) -> None:
        """Run the adjoints of steps from ``last`` to ``stop`` + 1."""
        for n in range(last, stop, -self._per_call):
            self._reverse.run(n, min(self._per_call, n - stop), -1)
            self._add_partials()

    def _add_partials(self) -> None:
        for key, partials in self._partials.items():
            self._grad_rows[key] += partials.sum(dim=(0, 2))
            partials.zero_()

    def _record_reverse(self) -> None:
        """Record the reverse loop and allocate what it needs."""
        ws = self._ws
        steps = max(1, min(ws.size.n_states - 1, self._per_call))
        for (part, k), rows in self._rows.items():
            _, here, weights = self._parts[part][k]
            if weights:
                shape = analytic_kernels.partial_shape(len(rows), here.stop - here.start, ws.F)
                self._partials[part, k] = torch.zeros((steps, *shape), dtype=torch.float64)
                self._grad_rows[part, k] = self._partials[part, k].sum(dim=(0, 2))
        stresses = [*self._stress_adjoints(), ws.native.add_elastic]
        transfers = [*ws.native.to_grid, *ws.native.adjoint[self._elastic]]
        if self._elastic:
            again = [] if self._caches_steps else self._stresses()
            self._reverse = LaunchSequence([*again, *transfers, *stresses])
            return
        flows, trial = self._flow_adjoints(), [one.earlier() for one in ws.native.to_trial]
        again = [] if self._caches_steps else [*trial, *self._flows(earlier=True)]
        self._reverse = LaunchSequence([*flows, *again, *transfers])
        self._again = LaunchSequence([*ws.native.to_trial, *self._flows()])
        self._adjoint_flow, self._adjoint_rest = LaunchSequence(flows), LaunchSequence(transfers)
        self._adjoint_stress = LaunchSequence(stresses)

    def _new_caches(self, cache_bytes: float) -> dict[int, Tensor]:
        """Memory for singular values by region, which later rollouts of the workspace use again."""
        ws, caches = self._ws, {}
        for k in self._regions:
            law, here, _ = self._parts["elasticity"][k]
            keeps = law.keeps_singular_values or self._parts["plasticity"][k][0].keeps_singular_values
            if not keeps:
                continue
            rows = len(self._rows["elasticity", k])
            shape = (
                ws.size.n_cached_steps,
                *analytic_kernels.cache_shape(rows, here.stop - here.start, ws.F),
            )
            cache_bytes -= math.prod(shape) * ws.F.element_size() if self._caches_steps else 0
            if cache_bytes >= 0:
                key = "segment", k, shape
                if key not in ws.law_caches:
                    ws.law_caches[key] = ws.F.new_empty(shape)
                caches[k] = ws.law_caches[key]
        return caches

    def _stresses(self) -> list[Repeated]:
        ws = self._ws
        kernel = analytic_kernels.evaluate_kernel("elasticity", ws.size.dtype)
        values = dict(F=(ws.F, "now"), out=(ws.tau, "stressed"))
        return [self._launch(kernel, "elasticity", k, values, self._elastic) for k in self._regions]

    def _stress_adjoints(self) -> list[Repeated]:
        ws = self._ws
        kernel = analytic_kernels.vjp_kernel("elasticity", ws.size.dtype)
        values = dict(F=(ws.F, "now"), grad_out=(ws.grad_tau, None), grad_F=(ws.grad_F_elastic, None))
        partials = dict(partials="elasticity")
        return [self._launch(kernel, "elasticity", k, values, self._elastic, partials) for k in self._regions]

    def _flows(self, earlier: bool = False) -> list[Repeated]:
        """Return map of a step and the stress of the next, or the same of the step before."""
        ws = self._ws
        kernel = analytic_kernels.flow_kernel(ws.size.dtype)
        values = dict(F=(ws.F_trial, "cached"), out=(ws.F, "after"), stress_out=(ws.tau, "stressed after"))
        launches = [self._launch(kernel, "plasticity", k, values, True) for k in self._regions]
        return [one.earlier() for one in launches] if earlier else launches

    def _flow_adjoints(self) -> list[Repeated]:
        ws = self._ws
        kernel = analytic_kernels.flow_vjp_kernel(ws.size.dtype)
        values = dict(
            F=(ws.F_trial, "cached"),
            returned_F=(ws.F, "after"),
            grad_out=(ws.grad_F, None),
            grad_stress=(ws.grad_tau, None),
            grad_F=(ws.grad_F_trial, None),
        )
        partials = dict(partials="plasticity", elastic_partials="elasticity")
        return [self._launch(kernel, "plasticity", k, values, True, partials) for k in self._regions]

    def _launch(
        self,
        kernel: wp.Kernel,
        part: str,
        k: int,
        values: Mapping[str, tuple[Tensor, str | None]],
        caches: bool,
        partials: Mapping[str, str] = {},
    ) -> Repeated:
        """A kernel of the law of a part and region.

        Args:
            values: argument by name: values of all particles, and the index of their first axis if there is one.
            caches: whether it uses the singular values of the region.
            partials: argument by name: the part of the law whose gradients it receives.
        """
        ws, rows = self._ws, self._rows[part, k]
        _, here, _ = self._parts[part][k]
        labels = {arg.label: position for position, arg in enumerate(kernel.adj.args)}
        given = {"rows": rows.data_ptr(), "copies": len(rows), "n": (here.stop - here.start) // len(rows)}
        if "elastic_rows" in labels:
            given["elastic_rows"] = self._rows["elasticity", k].data_ptr()
        indices = {}
        for name, (value, at) in values.items():
            given[name] = (value if at is None else value[0])[here].data_ptr()
            if at is not None:
                indices[labels[name]] = ws.native.index(at)._replace(base=given[name], stride=_stride(value))
        by_step = {name: self._partials.get((own, k)) for name, own in partials.items()}
        by_step["cache"] = self._caches.get(k) if caches else None
        for name, value in by_step.items():
            if value is not None:
                given[name] = value.data_ptr()
                indices[labels[name]] = Index(0, len(value), given[name], _stride(value))
        return Repeated(_launch(kernel), indices, {labels[name]: value for name, value in given.items()})


@cache
def _launch(kernel: wp.Kernel) -> wp.Launch:
    """A recorded launch of a law's kernel, whose arguments are numbers."""
    inputs = [0] * len(kernel.adj.args)
    return wp.launch(kernel, dim=1, inputs=inputs, device="cpu", block_dim=1, record_cmd=True)


def _stride(value: Tensor) -> int:
    """Bytes between the items of the first axis."""
    return value.stride(0) * value.element_size()
