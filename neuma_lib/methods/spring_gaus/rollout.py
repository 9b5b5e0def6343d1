"""Simulation of a network of springs in the box, differentiable, with a guard against steps that are too long."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import torch
import warp as wp
from torch import Tensor
from torch.autograd.function import once_differentiable

from neuma_lib.device import warp_stream
from neuma_lib.errors import NonFiniteError
from neuma_lib.methods.spring_gaus.kernels import kernels, warp_types
from neuma_lib.methods.spring_gaus.network import SpringNetwork, Springs
from neuma_lib.sim.model import MPMModel

MOST_SUBSTEPS = 256
"""Substeps of a time step beyond which a network counts as unstable."""


@dataclass(frozen=True)
class SpringModel:
    """Constants of the simulation.

    Attributes:
        dt: time step that frames are counted in [s].
        gravity: acceleration [m/s^2].
        low, high: coordinates on every axis of the planes, before the gap of the springs [m].
        substeps: equal parts that a time step is taken in, at least.
    """

    dt: float
    gravity: tuple[float, float, float]
    low: float
    high: float
    substeps: int = 1

    @classmethod
    def of(cls, model: MPMModel, substeps: int = 1) -> SpringModel:
        """Gravity, time step and box of another simulator, with planes where bodies come to rest in it."""
        low, high = model.free_range  # half a cell before the walls
        half = 0.5 * model.dx
        return cls(model.dt, model.gravity, low - half, high + half, substeps)


def spring_rollout(
    model: SpringModel,
    springs: Springs,
    x0: Tensor,
    v0: Tensor,
    frames: Sequence[int],
    first: int = 0,
    log: Callable[[str], None] | None = None,
) -> tuple[Tensor, Tensor, SpringModel]:
    """Positions and velocities of the anchors at frames.

    Differentiable with respect to x0, v0 and the parameters of the springs.

    Args:
        model: time step, gravity and box. A time step is taken in as many substeps as `SpringNetwork.stable_step`
            needs, but no fewer than ``model.substeps``. Where anchors still run away, in twice as many, and so on.
        springs: network and what is learned of it.
        x0, v0: anchors at the start, shape (A, 3) [m], [m/s].
        frames: time steps of the frames, increasing, from ``first`` on, which is the start.
        first: time step of the start.
        log: receives a line for every halving of the step.

    Returns:
        x and v at the frames, shape (T, A, 3); the model with the substeps that they were found with.

    Raises:
        NonFiniteError: anchors run away even in `MOST_SUBSTEPS` substeps; has `step` and `particle`.
    """
    values = springs.values()
    safe = springs.network.stable_step(*(value.detach() for value in values[:3]))
    needed = model.dt / safe if safe > 0 else math.inf  # NaN where a stiffness is infinite
    substeps = max(model.substeps, math.ceil(min(needed, MOST_SUBSTEPS + 1)))
    counts = [n - first for n in frames]
    while True:
        if substeps > MOST_SUBSTEPS:
            raise NonFiniteError(
                "springs",
                f"too stiff for {MOST_SUBSTEPS} substeps of {model.dt:g} s; lower springs.lr_springs or springs.guess",
            )
        model = replace(model, substeps=substeps)
        try:
            x, v = _Rollout.apply(model, springs.network, counts, first, x0, v0, *values)
            return x, v, model
        except NonFiniteError as error:
            if 2 * substeps > MOST_SUBSTEPS:
                raise
            substeps *= 2
            if log:
                log(f"{error}; each step is taken in {substeps} parts from here on")


class _Rollout(torch.autograd.Function):
    """All substeps as one function of the start and the values of the springs."""

    @staticmethod
    def forward(ctx, model, network, counts, first, x0, v0, *values):
        steps = counts[-1] * model.substeps
        A = len(x0)
        x, v = (value.new_empty(steps + 1, A, 3) for value in (x0, v0))
        x[0], v[0] = x0, v0
        values = tuple(value.detach().contiguous() for value in values)
        ctx.launcher = _Launcher(model, network, values, x, v)
        ctx.launcher.forward(steps)
        _check(model, network, x, v, first)
        ctx.kept = [n * model.substeps for n in counts]
        return x[ctx.kept], v[ctx.kept]

    @staticmethod
    @once_differentiable
    def backward(ctx, grad_x, grad_v):
        return None, None, None, None, *ctx.launcher.backward(ctx.kept, grad_x, grad_v)


def _check(model: SpringModel, network: SpringNetwork, x: Tensor, v: Tensor, first: int) -> None:
    """Whether any anchor ran away: in a closed box a wild one need not become infinite."""
    fast = v.abs().amax(-1) * (model.dt / model.substeps) > network.reach
    wrong = fast | ~(x.isfinite() & v.isfinite()).all(-1)
    if wrong.any():
        at, anchor = wrong.nonzero()[0].tolist()
        step = first + at // model.substeps
        finite = bool(x[at, anchor].isfinite().all() & v[at, anchor].isfinite().all())
        happened = (
            "moved by more than the spacing of the anchors in a substep" if finite else "became non-finite"
        )
        detail = f"anchor {anchor} {happened} at step {step} in {model.substeps} substeps each"
        raise NonFiniteError("springs", detail, step, anchor, happened)


class _Launcher:
    """Launches over the buffers of a rollout."""

    def __init__(self, model, network, values, x, v):
        self.x, self.v, self.values, self.network = x, v, values, network
        t = warp_types(x.dtype)
        c = t.SpringConstants()
        c.dt, c.gravity = model.dt / model.substeps, t.vec3(*model.gravity)
        c.low, c.high, c.exponent = model.low, model.high, network.exponent
        self._constants = c
        self._shared = (network.neighbours, network.rest, *values, x, v)

    def forward(self, steps: int) -> None:
        launch = self._recorded(kernels(self.x.dtype).step, 0, *self._shared)
        for step in range(steps):
            self._run(launch, step)

    def backward(self, kept: list[int], grad_x: Tensor, grad_v: Tensor) -> tuple[Tensor, ...]:
        """Gradients of x0, v0 and the values of the springs, for those of the kept states."""
        A, K = self.network.rest.shape
        like = self.x
        of_x, of_v = like.new_zeros(2, A, 3), like.new_zeros(2, A, 3)
        sums = [like.new_zeros(shape) for shape in ((A,), (A, K), (A,), (A,), (A,))]
        launch = self._recorded(kernels(like.dtype).step_adjoint, 0, 0, *self._shared, of_x, of_v, *sums)
        frames = {step: i for i, step in enumerate(kept)}
        for step in range(kept[-1], -1, -1):
            side = step % 2
            if step in frames:
                of_x[side] += grad_x[frames[step]]
                of_v[side] += grad_v[frames[step]]
            if step:
                self._run(launch, step - 1, side)
        stiffness, eta, *single = sums
        return of_x[0], of_v[0], stiffness, eta.sum(0), *(value.sum(0, keepdim=True) for value in single)

    def _recorded(self, kernel: wp.Kernel, *arguments) -> wp.Launch:
        parameters = kernel.adj.args[1:]
        inputs = [
            wp.from_torch(a, p.type.dtype, requires_grad=False) if torch.is_tensor(a) else a
            for a, p in zip(arguments, parameters, strict=True)
        ]
        return wp.launch(
            kernel,
            dim=len(self.network.rest),
            inputs=[self._constants, *inputs],
            device=wp.device_from_torch(self.x.device),
            record_cmd=True,
        )

    def _run(self, launch: wp.Launch, *indices: int) -> None:
        """Launch with these values of the integer parameters that follow the constants."""
        for i, index in enumerate(indices):
            launch.set_param_at_index_from_ctype(i + 1, index)
        launch.launch(warp_stream(self.x.device))
