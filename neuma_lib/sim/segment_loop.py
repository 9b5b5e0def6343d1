"""The steps of a segment in one call on a CPU, if all laws have kernels (`Constitutive.kernel`).

Other laws run in Python between the transfers, step by step (`Simulation.step`).
"""

import math
import weakref
from collections.abc import Mapping, Sequence
from functools import cache
from typing import Any

import torch
import warp as wp
from torch import Tensor

from neuma_lib.mechanics import analytic_kernels
from neuma_lib.mechanics.law import Constitutive, Weights
from neuma_lib.sim.sequence import Index, LaunchSequence, Repeated
from neuma_lib.sim.workspace import Workspace

PARTICLE_STEPS = 1_000_000
"""Particles times steps in one call, which takes up to 0.3 s on a slow core. Signals wait for its end."""
SLOWER = 8  # factor for networks

Parts = Mapping[str, Sequence[tuple[Constitutive, slice, Weights]]]
"""For elasticity and plasticity: law, particles and weights of each region."""


def segment_loop(
    ws: Workspace, parts: Parts, caches_steps: bool, cache_bytes: float, tracers: Repeated | None = None
) -> "SegmentLoop":
    """A `SegmentLoop` for these arguments, that of the last rollout in the workspace if it has the same ones."""
    given = [
        (
            kernel,
            law.identity,
            law.keeps_singular_values,
            here.start,
            here.stop,
            *arguments.values(),
            *weights,
        )
        for regions in parts.values()
        for law, here, weights in regions
        for kernel, arguments in [law.kernel(ws.F[0][here], weights, False)]
    ]
    key = [tuple(map(_number, each)) for each in given], caches_steps, cache_bytes, PARTICLE_STEPS
    if tracers is not None:
        return SegmentLoop(ws, parts, caches_steps, cache_bytes, tracers)
    if ws.loop is None or ws.loop[0] != key:
        loop = SegmentLoop(weakref.proxy(ws), parts, caches_steps, cache_bytes)
        ws.loop = key, loop, given  # kept, so that no other tensors have their addresses
    loop = ws.loop[1]
    loop.clear_sums()
    return loop


class SegmentLoop:
    """Forward and reverse loops over the steps of a segment.

    If a region has a return map, the stress of a step is computed at the end of the previous one, because both need the
    same singular vectors. Only the first stress of a simulation is computed from F alone.
    For the same bytes, a segment is therefore recomputed from the F_trial before its first F.

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
        self._regions = range(len(parts["elasticity"]))
        self._elastic = all(law.identity for law, _, _ in parts["plasticity"])
        self._flowing = not self._elastic
        self._memory: list[Any] = []  # arguments of the kernels
        self._caches = self._new_caches(cache_bytes)
        fast = all(law.native_rows for regions in parts.values() for law, _, _ in regions)
        self._per_call = max(1, PARTICLE_STEPS // (1 if fast else SLOWER) // ws.size.particles)
        self._partials: dict[tuple[str, int], Tensor] = {}  # of analytic laws in the steps of a call
        self._sums: dict[tuple[str, int], Weights] = {}  # gradients of rows of coefficients, or of weights
        last = [] if tracers is None else [tracers]
        before, flow = ([], self._flows()) if self._flowing else (self._stresses(), [])
        moves = ws.native.to_particles[self._elastic]
        self._forward = LaunchSequence([*before, *ws.native.to_grid, *moves, *flow, *last])
        self._stress, self._flow = LaunchSequence(self._stresses()), LaunchSequence(flow)
        self._reverse: LaunchSequence | None = None

    def clear_sums(self) -> None:
        """Clear gradients of the weights that an interrupted reverse loop has left."""
        for own in (*self._partials.values(), *(own for sums in self._sums.values() for own in sums)):
            own.zero_()

    def start(self, steps: int | None) -> None:
        """Set the first stress of a segment after one of some steps, or the first of the simulation."""
        if self._flowing and steps is None:
            self._stress.run(0)
        elif self._flowing:
            self._ws.tau[0].copy_(self._ws.tau[self._ws.stress_at(steps)])

    def before(self, steps: int | None) -> Tensor:
        """Value from which `restart` computes the first F of a segment: F_trial if the loop returns, else F."""
        ws = self._ws
        return ws.F[0] if not self._flowing or steps is None else ws.F_trial[ws.cached_at(steps - 1)]

    def restart(self, before: Tensor | None) -> None:
        """Set the first F and stress of a segment from the result of `before`, None for the first segment."""
        ws = self._ws
        if not self._flowing or before is None:
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
        self._before = before
        if self._flowing and not self._caches_steps:
            self._again.run(steps - 1)

    def reverse(self, last: int, steps: int) -> None:
        """Run the adjoints of steps from ``last`` down."""
        stop = last - steps
        if stop < 0 and self._flowing and not self._caches_steps:
            self._reverse_all(last, 0)
            self._adjoint_flow.run(0)
            self.restart(self._before)
            self._adjoint_rest.run(0)
            self._add_partials()
        else:
            self._reverse_all(last, stop)

    def end_reverse(self, part: str, sums: Sequence[Weights]) -> None:
        """Add the gradients of a part's weights since the last call to those of all regions, in `accumulators`."""
        for k, received in enumerate(sums):
            for total, own in zip(received, self._sums.get((part, k), ()), strict=True):
                total[..., -own.shape[-1] :] += own
                own.zero_()

    def end(self) -> None:
        """Add the part through the first stress of a simulation to the gradient of its F."""
        if self._flowing:
            self._adjoint_stress.run(0)
            self._add_partials()

    def _reverse_all(self, last: int, stop: int) -> None:
        """Run the adjoints of steps from ``last`` to ``stop`` + 1."""
        for n in range(last, stop, -self._per_call):
            self._reverse.run(n, min(self._per_call, n - stop), -1)
            self._add_partials()

    def _add_partials(self) -> None:
        for key, partials in self._partials.items():
            self._sums[key][0].add_(partials.sum(dim=(0, 2)))
            partials.zero_()

    def _record_reverse(self) -> None:
        """Record the reverse loop and allocate what it needs."""
        ws = self._ws
        steps = max(1, min(ws.size.n_states - 1, self._per_call))
        for part, regions in self._parts.items():
            for k, (law, here, weights) in enumerate(regions):
                if weights and law.native_rows:
                    rows = law.kernel_rows(ws.F, weights)
                    shape = analytic_kernels.partial_shape(len(rows), here.stop - here.start, ws.F)
                    self._partials[part, k] = torch.zeros((steps, *shape), dtype=torch.float64)
                    self._sums[part, k] = (self._partials[part, k].sum(dim=(0, 2)),)
                elif weights:
                    self._sums[part, k] = tuple(torch.zeros_like(w) for w in weights)
        stresses = [*self._stress_adjoints(), ws.native.add_elastic]
        transfers = [*ws.native.to_grid_again, *ws.native.adjoint[self._elastic]]
        if not self._flowing:
            again = [] if self._caches_steps else self._stresses()
            self._reverse = LaunchSequence([*again, *transfers, *stresses])
            return
        flows, trial = self._flow_adjoints(), [one.earlier() for one in ws.native.to_trial]
        again = [] if self._caches_steps else [*trial, *self._flows(earlier=True)]
        self._reverse = LaunchSequence([*flows, *again, *transfers])
        self._again = LaunchSequence([*ws.native.to_trial, *self._flows()])
        self._adjoint_flow, self._adjoint_rest = LaunchSequence(flows), LaunchSequence(transfers)
        self._adjoint_stress = LaunchSequence(stresses)

    def _new_caches(self, cache_bytes: float) -> dict[tuple[str, int], Tensor]:
        """Memory for singular values by part and region, which later rollouts of the workspace use again.

        A return map and the stress after it use that of the return map if both can.
        """
        ws, caches = self._ws, {}
        for k in self._regions:
            elastic, plastic = laws = [self._parts[part][k][0] for part in ("elasticity", "plasticity")]
            together = self._flowing and not self._is_separate(k)
            shared = together and not self._is_analytic(k)
            users = {"plasticity": laws} if together else {"elasticity": [elastic]}
            if self._flowing and not together and not plastic.native_rows:
                users["plasticity"] = [plastic]
            for part, own in users.items():
                keeps = ws.size.differentiable and any(law.keeps_singular_values for law in own)
                if not keeps and not shared:
                    continue
                law, here, weights = self._parts[part][k]
                one = law.cache_shape(ws.F[0][here], weights)
                shape = (ws.size.n_cached_steps, *one)
                needed = math.prod(shape) * ws.F.element_size() if self._caches_steps else 0
                if needed > cache_bytes and shared:
                    shape, needed = (1, *one), 0
                if needed <= cache_bytes:
                    cache_bytes -= needed
                    key = "segment", part, k, shape
                    if key not in ws.law_caches:
                        ws.law_caches[key] = ws.F.new_empty(shape)
                    caches[part, k] = ws.law_caches[key]
        return caches

    def _stresses(self) -> list[Repeated]:
        return self._each("elasticity", False, F=(self._ws.F, "now"), out=(self._ws.tau, "stressed"))

    def _stress_adjoints(self) -> list[Repeated]:
        ws = self._ws
        grads = dict(grad_out=(ws.grad_tau, None), grad_F=(ws.grad_F_elastic, None))
        return self._each("elasticity", True, F=(ws.F, "now"), **grads)

    def _each(self, part: str, backward: bool, **values: tuple[Tensor, str | None]) -> list[Repeated]:
        """Launches of the kernels of all regions, see `_launch`. The first stress has no cache if there are flows."""
        caches = {} if self._flowing else self._caches
        return [self._one(part, k, backward, caches.get((part, k)), {}, values) for k in self._regions]

    def _one(
        self,
        part: str,
        k: int,
        backward: bool,
        cache: Tensor | None,
        given: Mapping[str, Any],
        values: Mapping[str, tuple[Tensor, str | None]],
    ) -> Repeated:
        """Launch of the kernel of a region, with further arguments by name."""
        law, here, weights = self._parts[part][k]
        kernel, own = law.kernel(self._ws.F[0][here], weights, backward)
        by_step = {"partials": self._partials.get((part, k))} if backward else {}
        if backward and not law.native_rows:
            own |= {f"total{i}": total for i, total in enumerate(self._sums.get((part, k), ()))}
        if cache is not None and not law.native_rows:
            own["cached"] = 2 if backward else 1
        return self._launch(kernel, here, {**own, **given}, {"cache": cache, **by_step}, values)

    def _flows(self, earlier: bool = False) -> list[Repeated]:
        """Return map of a step and the stress of the next, or the same of the step before."""
        ws, launches = self._ws, []
        kernel = analytic_kernels.flow_kernel(ws.size.dtype)
        F, out, tau = (ws.F_trial, "cached"), (ws.F, "after"), (ws.tau, "stressed after")
        for k in self._regions:
            cache = self._caches.get(("plasticity", k))
            if self._is_analytic(k):
                values = dict(F=F, out=out, stress_out=tau)
                launches.append(self._launch(kernel, *self._both(k), {"cache": cache}, values))
                continue
            launches.append(self._one("plasticity", k, False, cache, {}, dict(F=F, out=out)))
            launches.append(self._one("elasticity", k, False, *self._shared(k), dict(F=out, out=tau)))
        return [one.earlier() for one in launches] if earlier else launches

    def _flow_adjoints(self) -> list[Repeated]:
        ws, launches = self._ws, []
        kernel = analytic_kernels.flow_vjp_kernel(ws.size.dtype)
        F, returned = (ws.F_trial, "cached"), (ws.F, "after")
        grads = dict(grad_out=(ws.grad_F, None), grad_F=(ws.grad_F_trial, None))
        for k in self._regions:
            cache = self._caches.get(("plasticity", k))
            if self._is_analytic(k):
                by_step = {
                    "cache": cache,
                    "partials": self._partials.get(("plasticity", k)),
                    "elastic_partials": self._partials.get(("elasticity", k)),
                }
                values = dict(F=F, returned_F=returned, grad_stress=(ws.grad_tau, None), **grads)
                launches.append(self._launch(kernel, *self._both(k), by_step, values))
                continue
            # Singular values of the step are overwritten.
            if cache is not None and len(cache) < ws.size.n_cached_steps:
                launches.append(self._one("plasticity", k, False, cache, {}, dict(F=F, out=returned)))
            own, given = self._shared(k)
            values = dict(F=returned, grad_out=(ws.grad_tau, None), grad_F=(ws.grad_F, None))
            launches.append(self._one("elasticity", k, True, own, {"adds": 1, **given}, values))
            launches.append(self._one("plasticity", k, True, cache, {}, dict(F=F, **grads)))
        return launches

    def _shared(self, k: int) -> tuple[Tensor | None, dict[str, int]]:
        """Cache of the stress after the return map of a region, which has written it unless it is the identity."""
        if self._is_separate(k):
            return self._caches.get(("elasticity", k)), {}
        return self._caches["plasticity", k], {"cached": 3}

    def _is_separate(self, k: int) -> bool:
        """Whether the return map of a region has no singular values for the kernel of its stress."""
        reads = all(self._parts[part][k][0].shares_singular_values for part in ("elasticity", "plasticity"))
        return not self._is_analytic(k) and not reads

    def _is_analytic(self, k: int) -> bool:
        """Whether one kernel has the return map and the stress of a region."""
        return all(self._parts[part][k][0].native_rows for part in ("elasticity", "plasticity"))

    def _both(self, k: int) -> tuple[slice, dict[str, Any]]:
        """Particles of a region, and arguments for both of its laws."""
        (elastic, here, own), (plastic, _, weights) = (
            self._parts[part][k] for part in ("elasticity", "plasticity")
        )
        _, given = plastic.kernel(self._ws.F[0][here], weights, False)
        return here, {**given, "elastic_rows": elastic.kernel_rows(self._ws.F, own)}

    def _launch(
        self,
        kernel: wp.Kernel,
        here: slice,
        given: Mapping[str, Any],
        by_step: Mapping[str, Tensor | None],
        values: Mapping[str, tuple[Tensor, str | None]],
    ) -> Repeated:
        """A kernel for the particles of a region.

        Args:
            given: arguments by name, tensors or numbers.
            by_step: arguments with one item per step of the segment, if any.
            values: argument by name: values of all particles, and the index of their first axis if there is one.
        """
        ws, arguments, indices = self._ws, {}, {}
        labels = {arg.label: position for position, arg in enumerate(kernel.adj.args)}
        for name, value in given.items():
            self._memory.append(value)
            arguments[labels[name]] = _number(value)
        for name, (value, at) in values.items():
            address = (value if at is None else value[0])[here].data_ptr()
            arguments[labels[name]] = address
            if at is not None:
                indices[labels[name]] = ws.native.index(at)._replace(base=address, stride=_stride(value))
        for name, value in by_step.items():
            if value is not None:
                arguments[labels[name]] = value.data_ptr()
                indices[labels[name]] = Index(0, len(value), value.data_ptr(), _stride(value))
        return Repeated(_launch(kernel), indices, arguments)


@cache
def _launch(kernel: wp.Kernel) -> wp.Launch:
    """A recorded launch of a law's kernel, whose arguments are numbers."""
    inputs = [0] * len(kernel.adj.args)
    return wp.launch(kernel, dim=1, inputs=inputs, device="cpu", block_dim=1, record_cmd=True)


def _number(value: Any) -> Any:
    """An argument of a kernel, if it is a tensor its address."""
    return value.data_ptr() if isinstance(value, Tensor) else value


def _stride(value: Tensor) -> int:
    """Bytes between the items of the first axis."""
    return value.stride(0) * value.element_size()
