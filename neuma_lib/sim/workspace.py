"""Reusable buffers of a rollout of a given size, and the launches that use them.

Nothing is allocated per step. Launches are recorded with fixed memory and only their indices change.
"""

import math
import threading
import weakref
from collections.abc import Callable, Hashable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any, NamedTuple

import numpy as np
import torch
import warp as wp
from torch import Tensor

from neuma_lib.sim import kernels
from neuma_lib.sim.adjoint_kernels import adjoint_kernels
from neuma_lib.sim.bodies import MAX_RANGES, pair_table
from neuma_lib.sim.clamp_kernels import hold_type, holds
from neuma_lib.sim.colliders import SIZES, contact_radius
from neuma_lib.sim.contact_kernels import STICKING, distances, obstacle_type, obstacles
from neuma_lib.sim.graphs import MAX_GRAPHS, GraphCache
from neuma_lib.sim.kernels import NO_FAULT, deformation_kernels, forward_kernels
from neuma_lib.sim.model import MPM, WALLS
from neuma_lib.sim.native import NativeTransfers
from neuma_lib.sim.warp_types import warp_types
from neuma_lib.threads import thread_count

SORT_EVERY = 16  # steps between sorts of the particles by cell, for scatter methods that need it

BLOCK = 64
"""Threads per block on a GPU. Small blocks distribute better, since 30,000 particles are few for a GPU."""

LEAVING = 1e-3
"""Tolerance for round-off beyond the last position with a stencil [dx], where the weights still sum to 1."""

_CONDITION_CODES = {"no_slip": kernels.NO_SLIP, "slip": kernels.SLIP, "sticky": kernels.STICKY}


class WorkspaceSize(NamedTuple):
    """Parameters of the size and the launches of a workspace."""

    model: MPM
    particles: int
    dtype: torch.dtype
    device: torch.device
    n_states: int = 2  # stored states: before and after a step, or all states of a segment to differentiate
    n_cached_steps: int = 1  # steps whose stress and grids are stored
    n_checkpoints: int = 0  # number of segments if there are several
    differentiable: bool = False
    total: bool = False  # whether the state includes the total deformation
    copies: int = 1  # independent simulations with equal numbers of particles
    ranges: tuple[
        tuple[int, int], ...
    ] = ()  # particles and body of each range of a copy, if there are several bodies
    scatter: str = "atomic"  # scatter method
    n_poses: int = 1  # steps of a segment if colliders or clamps change

    @property
    def bodies(self) -> int:
        """Number of bodies of a copy."""
        return 1 + max((body for _, body in self.ranges), default=0)

    @property
    def fields(self) -> int:
        """Number of grids: one of each body of each copy."""
        return self.copies * self.bodies

    @property
    def n_stresses(self) -> int:
        """Number of stored stresses. On a CPU those after a step may be computed at its end."""
        return self.n_cached_steps + (self.scatter == "native")


class Workspace:
    """States, grids and gradients of the N particles of all copies.

    The states of steps n and n + `n_states` share memory, and so do the cached values of steps n and
    n + `n_cached_steps`.

    Attributes:
        x, v: positions [m] and velocities [m/s], shape (n_states, N, 3).
        C, F: affine velocities [1/s] and elastic deformation gradients, shape (n_states, N, 3, 3).
        F_total: total deformation gradients, shape (n_states, N, 3, 3), if the state includes them.
        stuck: tangential displacements of particles in contact [m], shape (n_states, N, 3), see `Collider`.
        states: x, v, F, C, optionally F_total, and stuck with contact of particles; grad_states: their gradients.
        tau: Kirchhoff stresses [Pa], shape (n_stresses, N, 3, 3).
        F_trial: trial deformation gradients, shape (n_cached_steps, N, 3, 3).
        grid: momentum [kg m/s] and mass [kg] of the nodes, shape (n_cached_steps, fields * nodes^3, 4).
        grid_v: velocity [m/s] of the nodes and 1 where there is mass, shape (n_cached_steps, fields * nodes^3, 4).
        mass, vol0: particle masses [kg], and initial volumes [m^3] times `State.stiffness`, shape (N,).
        radius: radii of the particles in contact [m], shape (N,).
        frictions: `MPM.frictions` of each copy, shape (copies, colliders + pairs).
        pairs: `bodies.pair_table` of each copy, shape (copies * bodies, bodies + 1).
        obstacles: colliders at the steps of a segment, or at one step if none changes, with the friction of each copy,
            shape (poses * copies, colliders).
        distances: values of the grids of colliders that are meshes.
        holds: clamps at the steps of a segment, or at one step if none changes, shape (poses, clamps).
        clamp: index of the clamp of each particle, or -1, shape (N,).
        held_mass, held_by: mass of clamped particles at the nodes [kg], and the largest index of their clamps.
        faults: first step and particle with a non-finite value, with a move of more than a cell in a step, and
            outside the grid, shape (copies, 3).
        order: particles sorted by cell every `SORT_EVERY` steps, shape (n_sorts, N).
        checkpoints: states at the start of each segment, shape (n_checkpoints, ...).
        grad_*: gradients of the above for one step, without the first axis. grad_grid has two sides that steps
            use alternately.
        law_caches: caches of the laws, kept here so that the next rollout can overwrite them.
        loop: `SegmentLoop` of the last rollout on a CPU, and its arguments.
        weights, grad_weights: weights of the laws and their gradients at fixed addresses, for the graphs.
        graphs: recorded loops over these buffers.
        native: the transfers of a CPU, or None. Its steps share a grid, and gradients of the nodes have one side.
    """

    def __init__(self, size: WorkspaceSize):
        self.size = size
        self._views: dict[int, wp.array] = {}
        self.law_caches: dict[tuple, Any] = {}
        self.loop: tuple[Any, Any, Any] | None = None
        self.graphs = GraphCache()
        self.weights: list[Tensor] = []
        self.grad_weights: list[Tensor] = []
        self._frame_grads: dict[Hashable, list[Tensor | None]] = {}
        N, nodes = size.particles, self._node_count
        states, cached = size.n_states, size.n_cached_steps
        self.x, self.v = self.buffer((states, N), "vec3"), self.buffer((states, N), "vec3")
        self.C, self.F = self.buffer((states, N), "mat33"), self.buffer((states, N), "mat33")
        self.states = (self.x, self.v, self.F, self.C)
        if size.total:
            self.F_total = self.buffer((states, N), "mat33")
            self.states += (self.F_total,)
        self.stuck = self.buffer((states, N) if self._contact else (1, 1), "vec3")
        if self._contact:
            self.states += (self.stuck,)
        self.tau = self.buffer((size.n_stresses, N), "mat33")
        self.F_trial = self.buffer((cached, N), "mat33")
        self.mass, self.vol0, self.radius = (self.buffer((N,), "real") for _ in range(3))
        self.native = NativeTransfers(self) if size.scatter == "native" else None
        if self.native:
            self.grid, self.grid_v, *_ = self.native.grids[:, None, :nodes]
        else:
            self.grid = self.buffer((cached, nodes), "vec4")
            self.grid_v = self.buffer((cached, nodes), "vec4")
        self.frictions = np.zeros((size.copies, len(size.model.frictions)))
        self.pairs = self.buffer((size.fields, size.bodies + 1), "real")
        self.obstacles = self._obstacles([0.0] * size.n_poses)
        self.distances = wp.array(
            distances(size.model.obstacles),
            dtype=warp_types(size.dtype).real,
            device=wp.device_from_torch(size.device),
        )
        self.holds = self._holds([0.0] * size.n_poses)
        self.clamp = self.buffer((N if size.model.clamps else 1,), dtype=torch.int32)
        held = nodes if size.model.clamps else 1
        self.held_mass, self.held_by = self.buffer((held,), "real"), self.buffer((held,), dtype=torch.int32)
        self.faults = self.buffer((size.copies, 3), dtype=torch.int64)
        self.checkpoints = tuple(
            value.new_empty(size.n_checkpoints, *value.shape[1:]) for value in self.states
        )
        self.sorts = size.scatter not in ("native", "atomic")
        n_sorts = -(-max(states - 1, 1) // SORT_EVERY) if self.sorts and size.differentiable else 1
        self.order = self.buffer((n_sorts, N if self.sorts else 1), dtype=torch.int32)
        self.cells = self.buffer((N if self.sorts else 1,), dtype=torch.int32)
        self._constants = _grid_constants(size)
        self._deformation = deformation_kernels(size.dtype)
        if self.native:
            self.native.record_forward()
        else:
            self._record_forward()
        if size.differentiable:
            self.grad_x, self.grad_v = self.buffer((N,), "vec3"), self.buffer((N,), "vec3")
            self.grad_C, self.grad_F = self.buffer((N,), "mat33"), self.buffer((N,), "mat33")
            self.grad_F_trial, self.grad_tau = self.buffer((N,), "mat33"), self.buffer((N,), "mat33")
            self.grad_F_elastic = self.buffer((N,), "mat33")
            self.grad_states = (self.grad_x, self.grad_v, self.grad_F, self.grad_C)
            if size.total:
                self.grad_F_total = self.buffer((N,), "mat33")
                self.grad_states += (self.grad_F_total,)
            self.grad_stuck = self.buffer((N if self._contact else 1,), "vec3")
            if self._contact:
                self.grad_states += (self.grad_stuck,)
            if self.native:
                self.native.record_adjoint()
            else:
                self.grad_grid = self.buffer((2, nodes), "vec4")
                of_bodies = nodes if size.ranges else 1
                self.grad_before, self.grad_around = (self.buffer((of_bodies,), "vec4") for _ in range(2))
                self._record_adjoint()

    def at(self, step: int) -> int:
        """Index of the state before a step."""
        return step % self.size.n_states

    def cached_at(self, step: int) -> int:
        """Index of F_trial and the grids of a step."""
        return step % self.size.n_cached_steps

    def stress_at(self, step: int) -> int:
        """Index of the stress of a step."""
        return step % self.size.n_stresses

    def sorted_at(self, step: int) -> int:
        """Index of the particle order in a step."""
        return step // SORT_EVERY % len(self.order)

    def sort(self, step: int) -> None:
        """Sort the particles by cell if the scatter method needs it, every `SORT_EVERY` steps."""
        if self.sorts and step % SORT_EVERY == 0:
            _run(self._cells, self.at(step))
            self.order[self.sorted_at(step)].copy_(torch.sort(self.cells, stable=True).indices)

    def load_particles(
        self, mass: Tensor, vol0: Tensor, frictions: np.ndarray, stiffness: Tensor | float = 1.0
    ) -> None:
        """Set masses [kg], volumes [m^3], factors on the stress and radii of the particles, and `frictions`."""
        self.mass.copy_(mass)
        self.vol0.copy_(stiffness * vol0)  # multiplies the stress only
        self.radius.copy_(contact_radius(vol0))
        changed, self.frictions = not np.array_equal(frictions, self.frictions), frictions
        if self.size.ranges:
            self._load_pairs(mass, vol0)
        if changed and self.size.n_poses == 1:
            self._load_obstacles([0.0])

    def _load_pairs(self, mass: Tensor, vol0: Tensor) -> None:
        """Set the constants of the pairs of bodies."""
        size, tables = self.size, []
        masses, volumes = np.zeros((2, size.copies, size.bodies))
        start = 0
        for k, (count, body) in enumerate(size.ranges):
            own = slice(start, start + count)
            masses[:, body] += mass.double().reshape(size.copies, -1)[:, own].sum(dim=1).cpu().numpy()
            if k == body:  # not a branch, whose volume is that of its body
                volumes[:, body] = vol0.double().reshape(size.copies, -1)[:, own].sum(dim=1).cpu().numpy()
            start += count
        for own, frictions in zip(
            volumes / masses, self.frictions[:, len(size.model.obstacles) :], strict=True
        ):
            tables.append(pair_table(size.model.pairs, frictions, own / size.model.dx**3, STICKING))
        self.pairs.copy_(torch.from_numpy(np.concatenate(tables)))

    def pose_at(self, step: int) -> int:
        """Pose of the obstacles in a step."""
        return step % self.size.n_poses

    def load_poses(self, first: int, steps: int) -> None:
        """Set the obstacles at the steps of a segment that starts at step ``first`` of the simulation."""
        if self.size.n_poses > 1:
            times = [self.size.model.dt * (first + n) for n in range(steps)]
            with self.stream():
                self._load_obstacles(times)
                source = self._holds(times)
                wp.copy(self.holds, source, count=source.size)

    def _load_obstacles(self, times: Sequence[float]) -> None:
        """Set the first rows of the obstacles."""
        if self._contact:
            with self.stream():
                source = self._obstacles(times)
                wp.copy(self.obstacles, source, count=source.size)

    def _obstacles(self, times: Sequence[float]) -> wp.array:
        """Colliders at some times [s], with the friction of each copy."""
        poses = obstacles(self.size.model.obstacles, tuple(times), self.size.dtype)
        rows = np.repeat(poses, self.size.copies, axis=0)
        of_obstacles = self.frictions[:, : len(self.size.model.obstacles)]
        rows["friction"] = np.tile(np.minimum(of_obstacles, STICKING), (len(times), 1))
        return wp.array(
            rows, dtype=obstacle_type(self.size.dtype), device=wp.device_from_torch(self.size.device)
        )

    def _holds(self, times: Sequence[float]) -> wp.array:
        """Clamps in the steps from some times [s] on."""
        model, dtype = self.size.model, self.size.dtype
        return wp.array(
            holds(model.clamps, tuple(times), model.dt, dtype),
            dtype=hold_type(dtype),
            device=wp.device_from_torch(self.size.device),
        )

    def load_weights(self, weights: Sequence[Tensor]) -> None:
        """Copy weights to their fixed addresses."""
        if [w.shape for w in weights] != [w.shape for w in self.weights]:
            self._clear_graphs()
            self.weights = [torch.empty_like(w, memory_format=torch.contiguous_format) for w in weights]
            self.grad_weights = [torch.zeros_like(w) for w in self.weights]
        for own, weight in zip(self.weights, weights, strict=True):
            own.copy_(weight)

    def load_frame_grads(self, name: Hashable, grads: Sequence[Tensor | None]) -> list[Tensor | None]:
        """Copy gradients of the frames to the fixed buffers of that name."""
        if name not in self._frame_grads:
            if len(self._frame_grads) == MAX_GRAPHS:
                self._clear_graphs()
            self._frame_grads[name] = [
                None if grad is None else torch.empty_like(grad, memory_format=torch.contiguous_format)
                for grad in grads
            ]
        for own, grad in zip(self._frame_grads[name], grads, strict=True):
            if own is not None:
                own.copy_(grad)
        return self._frame_grads[name]

    def _clear_graphs(self) -> None:
        """Drop graphs together with the buffers that they read."""
        self._frame_grads, self.graphs = {}, GraphCache()

    def start_segment(self) -> None:
        """Call it before the steps of a segment: it clears the nodes, to which particles add."""
        if not self.native and self.size.n_cached_steps > 1:
            self.grid.zero_()

    def transfer_to_grid(self, step: int, again: bool = False) -> None:
        """From tau and the state of a step to the velocities of the nodes, ``again`` in the reverse loop."""
        if self.native:
            self.native.run("to_grid_again" if again else "to_grid", step)
            return
        cached = self.cached_at(step)
        if self.size.n_cached_steps == 1:  # else `start_segment` clears those of all steps at once
            self.grid[cached].zero_()
        if self.size.model.clamps:
            self.held_mass.zero_()
            self.held_by.zero_()
        _run(self._p2g, self.at(step), cached, self.sorted_at(step), self.pose_at(step), self.at(step + 1))
        _run(self._grid_update, cached, self.pose_at(step))

    def transfer_to_particles(self, step: int) -> None:
        """From velocities of the nodes to x, v, C and the total deformation after the step, and to F_trial."""
        if self.native:
            self.native.run("to_particles", step)
            return
        now, after = self.at(step), self.at(step + 1)
        _run(self._g2p, now, after, self.cached_at(step), step, self.pose_at(step))
        if self.size.total:
            _run(self._total, now, after, after)

    def trial_deformation(self, step: int) -> None:
        """Recompute F_trial of a step from the F before and the C after it."""
        if self.native:
            self.native.run("to_trial", step)
            return
        _run(self._trial, self.at(step), self.at(step + 1), self.cached_at(step))

    def tracer_launch(self, tracers: Tensor, bodies: Sequence[int]) -> wp.Launch:
        """A recorded launch, for `move_tracers` and `SegmentLoop`, that advects `tracers` (M, 3) in place.

        ``bodies`` has the number of tracers of each body.
        """
        positions = wp.from_torch(tracers, dtype=warp_types(self.size.dtype).vec3)
        starts = np.cumsum([0, *(count for count, _ in self.size.ranges)])[: len(bodies)]
        first_of = self.buffer((len(tracers),), dtype=torch.int32)
        first_of.copy_(torch.from_numpy(np.repeat(starts, bodies)))
        if self.native:
            return self.native.tracer_launch(first_of, positions)
        rows = self._rows(self.grid_v)
        return self.record(self._deformation.advect_tracers, len(tracers), 0, rows, first_of, positions)

    def move_tracers(self, launch: wp.Launch, step: int) -> None:
        """Advect tracers by the node velocities of a step."""
        _run(launch, *([] if self.native else [self.cached_at(step)]))

    def transfer_adjoint(self, step: int) -> None:
        """From gradients of the state after a step and of F_trial to those of the state before it and of tau.

        grad_x, grad_v, grad_C and grad_F_total are updated in place, and grad_F is set to the contribution of F_trial.
        Call it for decreasing steps after clearing `grad_grid` once.
        """
        if self.native:
            self.native.run("adjoint", step)
            return
        now, after, cached = self.at(step), self.at(step + 1), self.cached_at(step)
        side = step % 2
        if self.size.total:
            _run(self._total_adjoint, now, after)
        _run(self._g2p_adjoint, now, after, cached, side, self.sorted_at(step), self.pose_at(step))
        if self.size.ranges:
            _run(self._body_contact_adjoint, cached, side)
        _run(self._grid_adjoint, cached, side)
        _run(self._p2g_adjoint, now, cached, side, self.pose_at(step))

    def gradient_sum(self, added: Sequence[Tensor | None]) -> Callable[[int], None]:
        """A function that adds grad_F_elastic to grad_F, and the gradients of a frame to `grad_states`.

        Args:
            added: gradients of each state at the frames, shape (T, N, ...). The function takes the index of a frame, or
                -1 for none.
        """
        given = [None if added[k] is None else added[k].contiguous() for k in (0, 2)]
        arrays = [
            wp.from_torch((unused if grad is None else grad).flatten(1))
            for grad, unused in zip(given, (self.x, self.F), strict=True)
        ]
        own = self.grad_x, self.grad_F
        flat = [wp.from_torch(total.flatten()) for total in (self.grad_F_elastic, *own)]
        launch = self.record(self._deformation.add_gradients, 9 * self.size.particles, 0, 0, *arrays, *flat)
        others = [
            (total, grad)
            for total, grad in zip(self.grad_states, added, strict=True)
            if grad is not None and not any(total is one for one in own)
        ]

        def add(frame: int) -> None:
            _run(launch, *(-1 if grad is None else frame for grad in given))
            for total, grad in others if frame >= 0 else ():
                total.add_(grad[frame])

        return add

    @contextmanager
    def stream(self) -> Iterator[None]:
        """Launch on torch's current stream, so that launches of torch and Warp are ordered."""
        if self.size.device.type != "cuda":
            yield
            return
        stream = wp.stream_from_torch(torch.cuda.current_stream(self.size.device))
        with wp.ScopedStream(stream, sync_enter=False):
            yield

    def buffer(self, shape: tuple[int, ...], kind: str = "", dtype: torch.dtype | None = None) -> Tensor:
        """Zeros of a kind of `warp_types`, or else numbers of a dtype, with a Warp view for the launches."""
        tail = {"vec3": (3,), "vec4": (4,), "mat33": (3, 3)}.get(kind, ())
        tensor = torch.zeros(shape + tail, dtype=dtype or self.size.dtype, device=self.size.device)
        self.add_view(tensor, kind)
        return tensor

    def add_view(self, tensor: Tensor, kind: str = "") -> None:
        """Make a tensor, which must live as long, an argument of `record`."""
        warp_type = getattr(warp_types(self.size.dtype), kind) if kind else None
        self._views[id(tensor)] = wp.from_torch(tensor, dtype=warp_type)

    def _rows(self, nodes: Tensor) -> wp.array:
        """View of nodes (..., nodes, 4) whose element b is the 3 x 4 matrix of nodes b, b + 1 and b + 2."""
        *lead, count, width = nodes.shape
        rows = nodes.as_strided((*lead, count - 2, 3, width), (*nodes.stride()[:-1], width, 1))
        return wp.from_torch(rows, dtype=warp_types(self.size.dtype).mat34)

    def record(self, kernel: wp.Kernel, dim: int, *args: int | Tensor | wp.array) -> wp.Launch:
        inputs = [self._views[id(arg)] if isinstance(arg, Tensor) else arg for arg in args]
        options = {"block_dim": BLOCK} if self.size.device.type == "cuda" else {}
        return wp.launch(
            kernel,
            dim=dim,
            inputs=[self._constants, *inputs],
            device=wp.device_from_torch(self.size.device),
            record_cmd=True,
            **options,
        )

    def clear_grids(self) -> None:
        """Clear nodes that are not numbers, which may be outside the spans, after a simulation that diverged."""
        if self.native:
            self.native.grids.zero_()

    @property
    def _contact(self) -> bool:
        """Whether particles touch colliders."""
        return self.size.model.contact == "particles"

    @property
    def features(self) -> tuple[str, ...]:
        """Features of the model for the kernels."""
        shapes = {collider.shape for collider in self.size.model.obstacles}
        has = {
            "contact": self._contact,
            **{shape: self._contact and shape in shapes for shape in SIZES if shape != "plane"},
            "clamps": bool(self.size.model.clamps),
            "bodies": bool(self.size.ranges),
            "walls": self.size.scatter == "native" and self.size.model.wall_nodes > 0,
        }
        return tuple(name for name, value in has.items() if value)

    @property
    def _node_count(self) -> int:
        """Number of nodes of all bodies of all copies."""
        return self.size.fields * self.size.model.nodes**3

    @property
    def _scattering_threads(self) -> int:
        """Threads of a scattering kernel, a multiple of `BLOCK` if the threads of a warp cooperate."""
        N = self.size.particles
        return -(-N // BLOCK) * BLOCK if self.sorts else N

    def _record_forward(self) -> None:
        k = forward_kernels(self.size.dtype, self.size.scatter, self.features)
        N, nodes = self.size.particles, self._node_count
        rows, rows_v = self._rows(self.grid), self._rows(self.grid_v)
        held = self.holds, self.clamp
        if self.sorts:
            self._cells = self.record(k.cells, N, 0, self.x, self.cells)
        self._p2g = self.record(
            k.p2g, self._scattering_threads, 0, 0, 0, 0, 0, self.order,
            self.x, self.v, self.C, self.tau, self.mass, self.vol0, self.radius,
            self.obstacles, self.distances, self.stuck, *held, self.held_mass, self.held_by, rows,
        )  # fmt: skip
        self._grid_update = self.record(
            k.grid_update, nodes, 0, 0,
            self.grid, self.grid_v, self.holds, self.held_mass, self.held_by, self.pairs,
        )  # fmt: skip
        self._g2p = self.record(
            k.g2p, N, 0, 0, 0, 0, 0,
            rows_v, self.x, self.v, self.C, self.F, self.F_trial, *held, self.faults,
        )  # fmt: skip
        self._trial = self.record(
            self._deformation.trial_deformation, N, 0, 0, 0, self.C, self.F, self.F_trial
        )
        if self.size.total:
            F_total = self.F_total
            self._total = self.record(
                self._deformation.trial_deformation, N, 0, 0, 0, self.C, F_total, F_total
            )

    def _record_adjoint(self) -> None:
        k = adjoint_kernels(self.size.dtype, self.size.scatter, self.features)
        N, nodes = self.size.particles, self._node_count
        rows_v, grad_rows = self._rows(self.grid_v), self._rows(self.grad_grid)
        held = self.holds, self.clamp
        self._g2p_adjoint = self.record(
            k.g2p_adjoint, self._scattering_threads, 0, 0, 0, 0, 0, 0, self.order,
            self.x, self.v, self.C, self.F, rows_v,
            self.grad_v, self.grad_C, self.grad_F_trial, self.grad_x, self.grad_F, *held, grad_rows,
        )  # fmt: skip
        of_contact = self.grad_before, self.grad_around
        if self.size.ranges:
            self._body_contact_adjoint = self.record(
                k.body_contact_adjoint, nodes, 0, 0, self.grid, self.grad_grid, self.pairs, *of_contact
            )
        self._grid_adjoint = self.record(k.grid_adjoint, nodes, 0, 0, self.grid, self.grad_grid, *of_contact)
        self._p2g_adjoint = self.record(
            k.p2g_adjoint, N, 0, 0, 0, 0,
            self.x, self.v, self.C, self.tau, self.mass, self.vol0, self.radius,
            self.obstacles, self.distances, self.stuck, *held, grad_rows,
            self.grad_x, self.grad_v, self.grad_C, self.grad_tau, self.grad_stuck,
        )  # fmt: skip
        if self.size.total:
            self._total_adjoint = self.record(
                self._deformation.total_adjoint, N, 0, 0, self.C, self.F_total, self.grad_C, self.grad_F_total
            )


# one for the autograd graph of the last iteration, one for the next; and one for each further thread
_POOL_SIZE = 2
_pool: list[Workspace] = []  # unused workspaces, the last used at the end
_pool_lock = threading.RLock()  # a user can be freed in any thread


def pooled_workspace(size: WorkspaceSize, user: object) -> Workspace:
    """A workspace of that size, from the pool if possible. It returns to the pool when `user` is freed."""
    with _pool_lock:
        matching = [workspace for workspace in _pool if workspace.size == size]
        if matching:
            _pool.remove(matching[-1])
    workspace = matching[-1] if matching else Workspace(size)
    workspace.faults.fill_(NO_FAULT)
    weakref.finalize(user, _give_back, workspace).atexit = False
    return workspace


def free_pool() -> None:
    """Release the memory of unused workspaces."""
    with _pool_lock:
        _pool.clear()


def _give_back(workspace: Workspace) -> None:
    with _pool_lock:
        _pool.append(workspace)
        del _pool[: 1 - _POOL_SIZE - thread_count()]


def _run(launch: wp.Launch, *indices: int) -> None:
    """Launch with the given values of the integer parameters that follow the constants."""
    for i, index in enumerate(indices):
        launch.set_param_at_index_from_ctype(i + 1, index)
    launch.launch()


def _grid_constants(size: WorkspaceSize):
    model, t = size.model, warp_types(size.dtype)
    c = t.GridConstants()
    c.particles, c.copies = size.particles // size.copies, size.copies
    ranges = size.ranges or ((c.particles, 0),)
    c.bodies, c.fields, c.ranges = size.bodies, size.fields, len(ranges)
    counts, body_of = zip(*ranges, *[(0, 0)] * (MAX_RANGES - len(ranges)), strict=True)
    c.starts, c.body_of = t.starts(*np.cumsum([0, *counts]).tolist()), t.body_of(*body_of)
    c.n, c.wall_nodes, c.first = model.nodes, model.wall_nodes, model.first_node
    c.faces = len(WALLS) if model.contact == "particles" else 0
    c.walls = t.walls(*(_CONDITION_CODES[condition] for condition in model.boundary))
    c.dx, c.inv_dx, c.dt = model.dx, float(model.grid), model.dt
    c.gravity = t.vec3(*model.gravity)
    low, high = model.stencil_range
    c.clamp_low, c.clamp_high = (low, high) if model.bounds_positions else (-math.inf, math.inf)
    c.leave_low, c.leave_high = low - LEAVING * model.dx, high + LEAVING * model.dx
    return c
