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
        self._caches = self._new_caches(cache_bytes) if ws.size.differentiable else {}
        self._elastic = all(law.identity for law, _, _ in parts["plasticity"])
        self._per_call = max(1, PARTICLE_STEPS // ws.size.particles)
        after = () if tracers is None else (tracers,)
        self._forward = LaunchSequence(
            [
                *self._stresses(),
                *ws.native.to_grid,
                *ws.native.to_particles[self._elastic],
                *self._returns(),
                *after,
            ]
        )
        self._reverse: LaunchSequence | None = None

    def advance(self, first: int, steps: int) -> None:
        """Run steps from ``first`` on."""
        for n in range(first, first + steps, self._per_call):
            self._forward.run(n, min(self._per_call, first + steps - n))

    def start_reverse(self) -> None:
        """Allocate what the reverse loop of a segment needs."""
        if self._reverse is None:
            self._reverse = self._reverse_sequence()
        for total in self._grad_rows.values():
            total.zero_()

    def reverse(self, last: int, steps: int) -> None:
        """Run the adjoints of steps from ``last`` down."""
        for n in range(last, last - steps, -self._per_call):
            self._reverse.run(n, min(self._per_call, n - last + steps), -1)
            for key, partials in self._partials.items():
                self._grad_rows[key] += partials.sum(dim=(0, 2))
                partials.zero_()

    def grad_rows(self, part: str, k: int) -> Tensor:
        """Gradient of the constants of a region's law, summed over the steps since `start_reverse`."""
        return self._grad_rows[part, k]

    def _reverse_sequence(self) -> LaunchSequence:
        ws = self._ws
        steps = max(1, min(ws.size.n_states - 1, self._per_call))
        self._partials: dict[tuple[str, int], Tensor] = {}  # of the steps of a call
        self._grad_rows: dict[tuple[str, int], Tensor] = {}
        adjoints: dict[str, list[Repeated]] = {}
        for part, regions in self._parts.items():
            F, at = (ws.F, _NOW) if part == "elasticity" else (ws.F_trial, _CACHED)
            grad_out, grad_F = (
                (ws.grad_tau, ws.grad_F_elastic) if part == "elasticity" else (ws.grad_F, ws.grad_F_trial)
            )
            adjoints[part] = []
            for k, (_, here, weights) in enumerate(regions):
                values = dict(F=(F, at), grad_out=(grad_out, None), grad_F=(grad_F, None))
                extra = {}
                if weights:
                    shape = analytic_kernels.partial_shape(
                        len(self._rows[part, k]), here.stop - here.start, F
                    )
                    self._partials[part, k] = torch.zeros((steps, *shape), dtype=torch.float64)
                    extra["partials"] = self._partials[part, k]
                    self._grad_rows[part, k] = self._partials[part, k].sum(dim=(0, 2))
                kernel = analytic_kernels.vjp_kernel(part, ws.size.dtype)
                adjoints[part].append(self._launch(kernel, part, k, values, extra))
        before = (
            [] if self._caches_steps else [*self._stresses(), *(() if self._elastic else ws.native.to_trial)]
        )
        return LaunchSequence(
            [
                *before,
                *ws.native.to_grid,
                *(() if self._elastic else adjoints["plasticity"]),
                *ws.native.adjoint[self._elastic],
                *adjoints["elasticity"],
                ws.native.add_elastic,
            ]
        )

    def _new_caches(self, cache_bytes: float) -> dict[tuple[str, int], Tensor]:
        """Memory for singular values by region, which later rollouts of the workspace use again."""
        ws, caches = self._ws, {}
        for (part, k), rows in self._rows.items():
            law, here, _ = self._parts[part][k]
            if not law.keeps_singular_values or part == "plasticity" and not self._caches_steps:
                continue
            shape = (
                ws.size.n_cached_steps,
                *analytic_kernels.cache_shape(len(rows), here.stop - here.start, ws.F),
            )
            cache_bytes -= math.prod(shape) * ws.F.element_size() if self._caches_steps else 0
            if cache_bytes >= 0:
                key = "segment", part, shape
                if key not in ws.law_caches:
                    ws.law_caches[key] = ws.F.new_empty(shape)
                caches[part, k] = ws.law_caches[key]
        return caches

    def _stresses(self) -> list[Repeated]:
        ws = self._ws
        kernel = analytic_kernels.evaluate_kernel("elasticity", ws.size.dtype)
        values = dict(F=(ws.F, _NOW), out=(ws.tau, _CACHED))
        return [self._launch(kernel, "elasticity", k, values) for k in range(len(self._parts["elasticity"]))]

    def _returns(self) -> list[Repeated]:
        if self._elastic:
            return []
        ws = self._ws
        kernel = analytic_kernels.evaluate_kernel("plasticity", ws.size.dtype)
        values = dict(F=(ws.F_trial, _CACHED), out=(ws.F, _AFTER))
        return [self._launch(kernel, "plasticity", k, values) for k in range(len(self._parts["plasticity"]))]

    def _launch(
        self,
        kernel: wp.Kernel,
        part: str,
        k: int,
        values: Mapping[str, tuple[Tensor, str | None]],
        by_step: Mapping[str, Tensor] = {},
    ) -> Repeated:
        """A law's kernel for a region.

        Args:
            values: argument by name: values of all particles, and the index of their first axis if there is one.
            by_step: arguments with one item per step of the segment.
        """
        ws, rows = self._ws, self._rows[part, k]
        _, here, _ = self._parts[part][k]
        labels = {arg.label: position for position, arg in enumerate(kernel.adj.args)}
        given = {"rows": rows.data_ptr(), "copies": len(rows), "n": (here.stop - here.start) // len(rows)}
        indices = {}
        for name, (value, at) in values.items():
            given[name] = (value if at is None else value[0])[here].data_ptr()
            if at is not None:
                indices[labels[name]] = ws.native.index(at)._replace(base=given[name], stride=_stride(value))
        if (part, k) in self._caches:
            by_step = {**by_step, "cache": self._caches[part, k]}
        for name, value in by_step.items():
            given[name] = value.data_ptr()
            indices[labels[name]] = Index(0, len(value), given[name], _stride(value))
        return Repeated(_launch(kernel), indices, {labels[name]: value for name, value in given.items()})


@cache
def _launch(kernel: wp.Kernel) -> wp.Launch:
    """A recorded launch of a law's kernel, whose arguments are numbers."""
    inputs = [0] * len(kernel.adj.args)
    return wp.launch(kernel, dim=1, inputs=inputs, device="cpu", block_dim=1, record_cmd=True)


_NOW, _AFTER, _CACHED = "now", "after", "cached"


def _stride(value: Tensor) -> int:
    """Bytes between the items of the first axis."""
    return value.stride(0) * value.element_size()
