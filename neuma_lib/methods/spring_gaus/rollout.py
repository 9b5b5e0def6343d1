"""Differentiable simulation of a network of springs in the box, with adaptive substeps."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import torch
import warp as wp
from torch import Tensor
from torch.autograd.function import once_differentiable

from neuma_lib.device import warp_stream
from neuma_lib.errors import InputError, NonFiniteError
from neuma_lib.methods.spring_gaus.kernels import kernels, warp_types
from neuma_lib.methods.spring_gaus.network import SpringNetwork, Springs
from neuma_lib.sim.model import MPM

MAX_SUBSTEPS = 256
"""Maximum number of substeps per time step. A network that needs more is considered unstable."""


@dataclass(frozen=True)
class SpringModel:
    """Constants of the simulation."""

    dt: float  # time step between consecutive frame numbers [s]
    gravity: tuple[float, float, float]  # acceleration [m/s^2]
    # low, high: coordinates of the planes on every axis, without the gap of the springs [m]
    low: float
    high: float
    substeps: int = 1  # minimum number of substeps per time step

    @classmethod
    def of(cls, model: MPM, substeps: int = 1) -> "SpringModel":
        """Gravity, time step and box of an MPM model, with planes where bodies come to rest in it."""
        if model.colliders or model.clamps:
            problem = "springs touch only the faces of the cube"
            raise InputError("spring_gaus", problem, "Leave this method out")
        low, high = model.free_range
        # contact of nodes starts half a cell before the wall
        half = 0.5 * model.dx if model.wall_nodes else 0.0
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
        model: time step, gravity and box. The number of substeps is that of `SpringNetwork.stable_step`, at least
            ``model.substeps``, and is doubled while the simulation diverges.
        x0, v0: initial positions [m] and velocities [m/s] of the anchors, shape (A, 3).
        frames: time steps of the frames, increasing, not less than ``first``.
        first: time step of the initial state.
        log: receives a line for every halving of the substep.

    Returns:
        x and v at the frames, shape (T, A, 3), and the model with the number of substeps used.

    Raises:
        NonFiniteError: the simulation diverges in `MAX_SUBSTEPS` substeps; has `step` and `particle`.
    """
    values = springs.values()
    safe = springs.network.stable_step(*(value.detach() for value in values[:3]))
    needed = model.dt / safe if safe > 0 else math.inf  # NaN if a stiffness is infinite
    substeps = max(model.substeps, math.ceil(min(needed, MAX_SUBSTEPS + 1)))
    counts = [n - first for n in frames]
    while True:
        if substeps > MAX_SUBSTEPS:
            raise NonFiniteError(
                "springs",
                f"too stiff for {MAX_SUBSTEPS} substeps of {model.dt:g} s. Lower springs.lr_springs or springs.guess",
            )
        model = replace(model, substeps=substeps)
        try:
            x, v = _Rollout.apply(model, springs.network, counts, first, x0, v0, *values)
            return x, v, model
        except NonFiniteError as error:
            if 2 * substeps > MAX_SUBSTEPS:
                raise
            substeps *= 2
            if log:
                log(f"{error}. Retrying with {substeps} substeps per time step")


class _Rollout(torch.autograd.Function):
    """All substeps as one function of the initial state and the values of the springs."""

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
    """Raise NonFiniteError if an anchor diverged, i.e. is not finite or too fast for the closed box."""
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
    """Kernel launches on the buffers of a rollout."""

    def __init__(self, model, network, values, x, v):
        self.x, self.v, self.values, self.network = x, v, values, network
        t = warp_types(x.dtype)
        c = t.SpringConstants()
        c.dt, c.gravity = model.dt / model.substeps, t.vec3(*model.gravity)
        c.low, c.high, c.exponent = model.low, model.high, network.exponent
        self._constants = c
        self._shared = (network.neighbours, network.rest, *values, x, v)

    def forward(self, steps: int) -> None:
        launch = self._record(kernels(self.x.dtype).step, 0, *self._shared)
        for step in range(steps):
            self._run(launch, step)

    def backward(self, kept: list[int], grad_x: Tensor, grad_v: Tensor) -> tuple[Tensor, ...]:
        """Gradients of x0, v0 and the values of the springs from those of the kept states."""
        A, K = self.network.rest.shape
        like = self.x
        of_x, of_v = like.new_zeros(2, A, 3), like.new_zeros(2, A, 3)
        sums = [like.new_zeros(shape) for shape in ((A,), (A, K), (A,), (A,), (A,))]
        launch = self._record(kernels(like.dtype).step_adjoint, 0, 0, *self._shared, of_x, of_v, *sums)
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

    def _record(self, kernel: wp.Kernel, *arguments) -> wp.Launch:
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
        """Launch with the given values of the integer parameters that follow the constants."""
        for i, index in enumerate(indices):
            launch.set_param_at_index_from_ctype(i + 1, index)
        launch.launch(warp_stream(self.x.device))
