"""Buffers of a rollout and the launches that work on them, made once for a size and used again.

Nothing here is allocated per step: launches are recorded on fixed memory and only their slot numbers change.
"""

from __future__ import annotations

import threading
from collections.abc import Hashable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any, NamedTuple

import torch
import warp as wp
from torch import Tensor

from neuma_lib.sim import kernels
from neuma_lib.sim.adjoint_kernels import adjoint_kernels
from neuma_lib.sim.graphs import MOST_GRAPHS, GraphCache
from neuma_lib.sim.kernels import NEVER, forward_kernels, warp_types
from neuma_lib.sim.model import MPMModel

SORT_EVERY = 16
"""Steps after which particles are sorted by cell again, where the scatter profits from it."""

BLOCK = 64
"""Threads of a block on a GPU: 30,000 particles are few, so small blocks spread better over the processors."""

_CONDITION_CODES = {"no_slip": kernels.NO_SLIP, "slip": kernels.SLIP, "sticky": kernels.STICKY}


class Layout(NamedTuple):
    """All that decides the size and content of a workspace."""

    model: MPMModel
    particles: int
    dtype: torch.dtype
    device: torch.device
    states: int  # slots of x, v, C, F: steps of a segment + 1 to differentiate, else 2
    kept: int  # slots of what a step computes on the way: steps of a segment to keep it, else 1
    differentiable: bool
    marks: int = 0  # slots of states at the start of a segment, if there are several
    scatter: str = "atomic"  # see `scatter`


class Workspace:
    """State, grid and gradients of N particles in `layout.states` and `layout.kept` slots.

    Attributes:
        x, v: positions [m] and velocities [m/s], shape (states, N, 3).
        C, F: affine velocities [1/s] and deformation gradients, shape (states, N, 3, 3).
        tau, F_trial: Kirchhoff stresses [Pa] and trial deformation gradients, shape (kept, N, 3, 3).
        grid: momentum [kg m/s] and mass [kg] of the nodes, shape (kept, grid^3, 4).
        grid_v: velocity [m/s] of the nodes and 1 where there is mass, shape (kept, grid^3, 4).
        mass, vol0: particle masses [kg] and initial volumes [m^3], shape (N,).
        faults: first step and particle of a non-finite value and of one outside the grid, shape (2,).
        order: particles sorted by cell, every `SORT_EVERY` steps, shape (epochs, N).
        marks: x, v, F and C at the start of each segment, shape (segments, ...), empty if there is only one.
        grad_*: gradients of the above for one step, without a slot axis. grad_grid has two sides that steps use
            in turn.
        caches: what the laws keep of their evaluations, owned here so that the next rollout can overwrite it.
        weights, grad_weights: weights of the laws and their gradients at a fixed place, for the graphs.
        graphs: recorded loops over these buffers.
    """

    def __init__(self, layout: Layout):
        self.layout = layout
        self._views: dict[int, wp.array] = {}
        self.caches: dict[tuple, Any] = {}
        self.graphs = GraphCache()
        self.weights: list[Tensor] = []
        self.grad_weights: list[Tensor] = []
        self._seeds: dict[Hashable, list[Tensor | None]] = {}
        N, nodes = layout.particles, layout.model.grid**3
        states, kept = layout.states, layout.kept
        self.x, self.v = self._vectors(states, N), self._vectors(states, N)
        self.C, self.F = self._matrices(states, N), self._matrices(states, N)
        self.tau, self.F_trial = self._matrices(kept, N), self._matrices(kept, N)
        self.grid, self.grid_v = self._nodes(kept, nodes), self._nodes(kept, nodes)
        self.mass, self.vol0 = self._scalars(N), self._scalars(N)
        self.faults = self._buffer((2,), None, torch.int64)
        self.marks = tuple(
            value.new_empty(layout.marks, *value.shape[1:]) for value in (self.x, self.v, self.F, self.C)
        )
        self.sorts = layout.scatter != "atomic"
        epochs = -(-max(states - 1, 1) // SORT_EVERY) if self.sorts and layout.differentiable else 1
        self.order = self._buffer((epochs, N if self.sorts else 1), None, torch.int32)
        self.cells = self._buffer((N if self.sorts else 1,), None, torch.int32)
        self._constants = _grid_constants(layout.model, layout.dtype)
        self._record_forward()
        if layout.differentiable:
            self.grad_x, self.grad_v = self._vectors(N), self._vectors(N)
            self.grad_C, self.grad_F = self._matrices(N), self._matrices(N)
            self.grad_F_trial, self.grad_tau = self._matrices(N), self._matrices(N)
            self.grad_F_elastic = self._matrices(N)
            self.grad_grid = self._nodes(2, nodes)
            self._record_adjoint()

    def state(self, step: int) -> int:
        """Slot of the state at the start of a step."""
        return step % self.layout.states

    def kept(self, step: int) -> int:
        """Slot of what a step computes on the way."""
        return step % self.layout.kept

    def epoch(self, step: int) -> int:
        """Slot of the order of the particles in a step."""
        return step // SORT_EVERY % len(self.order)

    def sort(self, step: int) -> None:
        """Order the particles by cell if the kernels profit from it and it is time to."""
        if self.sorts and step % SORT_EVERY == 0:
            _run(self._cells, self.state(step))
            self.order[self.epoch(step)].copy_(torch.sort(self.cells, stable=True).indices)

    def load_weights(self, weights: Sequence[Tensor]) -> None:
        """Copy weights to their fixed place."""
        if [w.shape for w in weights] != [w.shape for w in self.weights]:
            self._forget_graphs()
            self.weights = [torch.empty_like(w, memory_format=torch.contiguous_format) for w in weights]
            self.grad_weights = [torch.zeros_like(w) for w in self.weights]
        for own, weight in zip(self.weights, weights, strict=True):
            own.copy_(weight)

    def load_seeds(self, name: Hashable, seeds: Sequence[Tensor | None]) -> list[Tensor | None]:
        """Copy gradients of the frames to a fixed place of that name."""
        if name not in self._seeds:
            if len(self._seeds) == MOST_GRAPHS:
                self._forget_graphs()
            self._seeds[name] = [
                None if seed is None else torch.empty_like(seed, memory_format=torch.contiguous_format)
                for seed in seeds
            ]
        for own, seed in zip(self._seeds[name], seeds, strict=True):
            if own is not None:
                own.copy_(seed)
        return self._seeds[name]

    def _forget_graphs(self) -> None:
        """No graph may outlive what it reads."""
        self._seeds, self.graphs = {}, GraphCache()

    def transfer_to_grid(self, step: int) -> None:
        """tau and the state of a step to the velocities of the nodes."""
        kept = self.kept(step)
        self.grid[kept].zero_()
        _run(self._p2g, self.state(step), kept, self.epoch(step))
        _run(self._grid_update, kept)

    def transfer_to_particles(self, step: int) -> None:
        """Velocities of the nodes to x, v and C after the step, and to F_trial."""
        _run(self._g2p, self.state(step), self.state(step + 1), self.kept(step), step)

    def trial_deformation(self, step: int) -> None:
        """F_trial of a step again, from the F before and the C after it."""
        _run(self._trial, self.state(step), self.state(step + 1), self.kept(step))

    def tracer_launch(self, tracers: Tensor) -> wp.Launch:
        """A recorded launch, for `move_tracers`, that advects `tracers` (M, 3) in place."""
        kernel = forward_kernels(self.layout.dtype, self.layout.scatter).advect_tracers
        positions = wp.from_torch(tracers, dtype=warp_types(self.layout.dtype).vec3)
        return self._record(kernel, len(tracers), 0, self._rows(self.grid_v), positions)

    def move_tracers(self, launch: wp.Launch, step: int) -> None:
        """Advect tracers by the node velocities of a step."""
        _run(launch, self.kept(step))

    def transfer_adjoint(self, step: int) -> None:
        """Gradients of the state after a step and of F_trial to those of the state before it and of tau.

        grad_x, grad_v and grad_C hold the former on entry and the latter on return; grad_F is set to the part
        that comes through F_trial. Steps run downwards after `grad_grid` was cleared once.
        """
        state, after, kept = self.state(step), self.state(step + 1), self.kept(step)
        side = step % 2
        _run(self._g2p_adjoint, state, after, kept, side, self.epoch(step))
        _run(self._grid_adjoint, kept, side)
        _run(self._p2g_adjoint, state, kept, side)

    @contextmanager
    def stream(self) -> Iterator[None]:
        """Launch on torch's current stream, so that torch and Warp see each other's results in order."""
        if self.layout.device.type != "cuda":
            yield
            return
        stream = wp.stream_from_torch(torch.cuda.current_stream(self.layout.device))
        with wp.ScopedStream(stream, sync_enter=False):
            yield

    def _buffer(self, shape: tuple[int, ...], warp_type, dtype: torch.dtype | None = None) -> Tensor:
        """Zeros, and Warp's view of them for the launches."""
        tensor = torch.zeros(shape, dtype=dtype or self.layout.dtype, device=self.layout.device)
        self._views[id(tensor)] = wp.from_torch(tensor, dtype=warp_type)
        return tensor

    def _scalars(self, *lead: int) -> Tensor:
        return self._buffer(lead, warp_types(self.layout.dtype).real)

    def _vectors(self, *lead: int) -> Tensor:
        return self._buffer((*lead, 3), warp_types(self.layout.dtype).vec3)

    def _matrices(self, *lead: int) -> Tensor:
        return self._buffer((*lead, 3, 3), warp_types(self.layout.dtype).mat33)

    def _nodes(self, *lead: int) -> Tensor:
        return self._buffer((*lead, 4), warp_types(self.layout.dtype).vec4)

    def _rows(self, nodes: Tensor) -> wp.array:
        """View of nodes (..., nodes, 4) whose element b is the 3 x 4 matrix of nodes b, b + 1 and b + 2."""
        *lead, count, width = nodes.shape
        rows = nodes.as_strided((*lead, count - 2, 3, width), (*nodes.stride()[:-1], width, 1))
        return wp.from_torch(rows, dtype=warp_types(self.layout.dtype).mat34)

    def _record(self, kernel: wp.Kernel, dim: int, *args: int | Tensor | wp.array) -> wp.Launch:
        inputs = [self._views[id(arg)] if isinstance(arg, Tensor) else arg for arg in args]
        options = {"block_dim": BLOCK} if self.layout.device.type == "cuda" else {}
        return wp.launch(
            kernel,
            dim=dim,
            inputs=[self._constants, *inputs],
            device=wp.device_from_torch(self.layout.device),
            record_cmd=True,
            **options,
        )

    @property
    def _scattering_threads(self) -> int:
        """Threads of a kernel that scatters: whole warps where these work together."""
        N = self.layout.particles
        return -(-N // BLOCK) * BLOCK if self.sorts else N

    def _record_forward(self) -> None:
        k = forward_kernels(self.layout.dtype, self.layout.scatter)
        N, nodes = self.layout.particles, self.layout.model.grid**3
        rows, rows_v = self._rows(self.grid), self._rows(self.grid_v)
        if self.sorts:
            self._cells = self._record(k.cells, N, 0, self.x, self.cells)
        self._p2g = self._record(
            k.p2g, self._scattering_threads, 0, 0, 0, self.order,
            self.x, self.v, self.C, self.tau, self.mass, self.vol0, rows,
        )  # fmt: skip
        self._grid_update = self._record(k.grid_update, nodes, 0, self.grid, self.grid_v)
        self._g2p = self._record(
            k.g2p, N, 0, 0, 0, 0,
            rows_v, self.x, self.v, self.C, self.F, self.F_trial, self.faults,
        )  # fmt: skip
        self._trial = self._record(k.trial_deformation, N, 0, 0, 0, self.C, self.F, self.F_trial)

    def _record_adjoint(self) -> None:
        k = adjoint_kernels(self.layout.dtype, self.layout.scatter)
        N, nodes = self.layout.particles, self.layout.model.grid**3
        rows_v, grad_rows = self._rows(self.grid_v), self._rows(self.grad_grid)
        self._g2p_adjoint = self._record(
            k.g2p_adjoint, self._scattering_threads, 0, 0, 0, 0, 0, self.order,
            self.x, self.v, self.C, self.F, rows_v,
            self.grad_v, self.grad_C, self.grad_F_trial, self.grad_x, self.grad_F, grad_rows,
        )  # fmt: skip
        self._grid_adjoint = self._record(k.grid_adjoint, nodes, 0, 0, self.grid, self.grad_grid)
        self._p2g_adjoint = self._record(
            k.p2g_adjoint, N, 0, 0, 0,
            self.x, self.v, self.C, self.tau, self.mass, self.vol0, grad_rows,
            self.grad_x, self.grad_v, self.grad_C, self.grad_tau,
        )  # fmt: skip


class WorkspaceLease:
    """A workspace that goes back to the pool when nobody holds the lease, as when a graph is freed."""

    _idle: list[Workspace] = []
    _most_idle = 2  # one in use by the graph of the last iteration, one for the next
    _lock = threading.RLock()  # leases may end in any thread, and in the middle of taking one

    def __init__(self, layout: Layout):
        with self._lock:
            fitting = [workspace for workspace in self._idle if workspace.layout == layout]
            if fitting:
                self._idle.remove(fitting[-1])
        self.workspace = fitting[-1] if fitting else Workspace(layout)
        self.workspace.faults.fill_(NEVER)

    @classmethod
    def forget(cls) -> None:
        """Give the memory of idle workspaces back."""
        with cls._lock:
            cls._idle.clear()

    def __del__(self):
        if hasattr(self, "workspace"):
            with self._lock:
                self._idle.append(self.workspace)
                del self._idle[: -self._most_idle]


def _run(launch: wp.Launch, *numbers: int) -> None:
    """Launch with these values of the integer parameters (slots, step) that follow the constants."""
    for i, number in enumerate(numbers):
        launch.set_param_at_index_from_ctype(i + 1, number)
    launch.launch()


def _grid_constants(model: MPMModel, dtype: torch.dtype):
    t = warp_types(dtype)
    c = t.GridConstants()
    c.n, c.wall_cells = model.grid, model.wall_cells
    c.walls = t.walls(*(_CONDITION_CODES[condition] for condition in model.boundary))
    c.dx, c.inv_dx, c.dt = model.dx, float(model.grid), model.dt
    c.gravity = t.vec3(*model.gravity)
    c.x_low, c.x_high = model.stencil_range
    return c
