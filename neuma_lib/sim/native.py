"""Launches of `transfers` on a CPU for the buffers of a workspace."""

import weakref
from typing import TYPE_CHECKING

import torch
import warp as wp
from torch import Tensor

from neuma_lib.sim.kernels import deformation_kernels
from neuma_lib.sim.sequence import Index, LaunchSequence, Repeated
from neuma_lib.sim.transfers import transfer_kernels

if TYPE_CHECKING:
    from neuma_lib.sim.workspace import Workspace

PADDING = 1  # nodes beyond the end of a grid, which the loops read and write with the three before them


class NativeTransfers:
    """Launches of a step. Arguments of the kernels are buffers of the workspace, or of this object, by name.

    Attributes:
        grids: momentum and mass, velocity, and gradients of the nodes, shape (2 to 5, nodes + PADDING, 4). The last two
            are those of `body_contact`, if there are several bodies.
        to_grid: from tau and the state to the velocities of the nodes.
        to_grid_again: the same in the reverse loop.
        to_particles: from these to the state after the step. F_trial is the F of that state if the key is True.
        to_trial: recomputes F_trial.
        adjoint: from gradients of the state after the step and of F_trial, with the same keys, to those of the state
            before it and of tau.
        add_elastic: adds grad_F_elastic to grad_F.
    """

    def __init__(self, ws: "Workspace"):
        size, model = ws.size, ws.size.model
        self._ws = weakref.proxy(ws)  # which owns this object
        self._kernels = transfer_kernels(size.dtype, ws.features)
        self._deformation = deformation_kernels(size.dtype)
        gradients = (3 if size.ranges else 1) if size.differentiable else 0
        self.grids = ws.buffer((2 + gradients, size.fields * model.nodes**3 + PADDING), "vec4")
        of_contact = self.grids[3:] if size.differentiable and size.ranges else self.grids[:2]
        self.grad_before, self.grad_around = of_contact  # unused by one body
        for unpadded in (self.grad_before, self.grad_around):
            ws.add_view(unpadded, "vec4")
        self.spans = ws.buffer((size.fields * 6 * model.nodes**2,), dtype=torch.int32)
        kept = size.n_cached_steps if self._keeps_nodes else 1
        self.kept = ws.buffer((kept, size.particles if self._keeps_nodes else 0), "vec4")
        self.kept_spans = ws.buffer((kept, 2 * size.fields * model.nodes**2 + 1), dtype=torch.int32)
        self.mass_now, self.vol_now, self.radius_now = ws.mass, ws.vol0, ws.radius
        if model.clamps:
            self.mass_now, self.vol_now, self.radius_now = (
                ws.buffer((size.particles,), "real") for _ in range(3)
            )
        touching = size.particles if "contact" in ws.features else 1
        self.v_now = ws.buffer((touching,), "vec3")
        self.near = ws.buffer((touching,), dtype=torch.int32)
        self.touching = ws.buffer((1,), dtype=torch.int32)

    @property
    def _keeps_nodes(self) -> bool:
        """Whether the nodes of all steps of a segment are kept."""
        size = self._ws.size
        return size.differentiable and size.n_cached_steps == size.n_states - 1

    def record_forward(self) -> None:
        """Record the launches of a step."""
        k, N = self._kernels, self._ws.size.particles
        hold = [self._launch(k.hold, N)] if "clamps" in self._ws.features else []

        def to_grid(again: int) -> list[Repeated]:
            touch = [self._launch(k.touch, again=again)] if "contact" in self._ws.features else []
            p2g = self._launch(k.p2g, again=again and int(self._keeps_nodes))
            return [*hold, *touch, p2g, self._launch(k.grid_update)]

        self.to_grid, self.to_grid_again = to_grid(0), to_grid(1)
        self.to_trial = [self._launch(k.trial_deformation)]
        self.to_particles = {elastic: self._moves(elastic) for elastic in (False, True)}
        self._steps = {
            "to_grid": LaunchSequence(self.to_grid),
            "to_grid_again": LaunchSequence(self.to_grid_again),
            "to_particles": LaunchSequence(self.to_particles[False]),
            "to_trial": LaunchSequence(self.to_trial),
        }

    def record_adjoint(self) -> None:
        """Record the launches of the adjoint of a step."""
        self.add_elastic = self._launch(self._kernels.add)
        self.adjoint = {elastic: self._adjoints(elastic) for elastic in (False, True)}
        self._steps["adjoint"] = LaunchSequence(self.adjoint[False])

    def tracer_launch(self, first_of: Tensor, positions: wp.array) -> wp.Launch:
        """See `Workspace.tracer_launch`."""
        return self._ws.record(self._kernels.advect_tracers, 1, self.grids, first_of, positions)

    def run(self, name: str, step: int) -> None:
        """Run the launches of that name for a step."""
        self._steps[name].run(step)

    def index(self, name: str) -> Index:
        """How an index of the kernels depends on the step."""
        size = self._ws.size
        return {
            "now": Index(modulus=size.n_states),
            "after": Index(1, size.n_states),
            "cached": Index(modulus=size.n_cached_steps),
            "stressed": Index(modulus=size.n_stresses),
            "stressed after": Index(1, size.n_stresses),
            "pose": Index(modulus=size.n_poses),
            "step": Index(),
        }[name]

    def _moves(self, elastic: bool) -> list[Repeated]:
        ws, k = self._ws, self._kernels
        trial = dict(F_trial=ws.F, cached="after") if elastic else {}
        launches = [self._launch(k.g2p, **trial)]
        if "clamps" in ws.features:
            launches.append(self._launch(k.move_held, ws.size.particles, **trial))
            launches.append(self._launch(k.trial_deformation, **trial))  # the bytes of a recomputation
        if ws.size.total:
            total = dict(F=ws.F_total, F_trial=ws.F_total, cached="after")
            launches.append(self._launch(k.trial_deformation, **total))
        return launches

    def _adjoints(self, elastic: bool) -> list[Repeated]:
        ws, k, N = self._ws, self._kernels, self._ws.size.particles
        trial = dict(grad_F_trial=ws.grad_F) if elastic else {}
        launches = [self._launch(self._deformation.total_adjoint, N)] if ws.size.total else []
        launches.append(self._launch(k.g2p_adjoint, **trial))
        launches += [self._launch(k.held_adjoint, N, **trial)] if "clamps" in ws.features else []
        launches += [self._launch(k.body_contact_adjoint)] if ws.size.ranges else []
        launches += [self._launch(k.grid_adjoint), self._launch(k.p2g_adjoint)]
        launches += [self._launch(k.touch_adjoint)] if "contact" in ws.features else []
        return launches

    def _launch(self, kernel: wp.Kernel, dim: int = 1, **others: Tensor | str | int) -> Repeated:
        """A launch whose arguments after the constants are indices or buffers by name, or those of ``others``."""
        indices, arguments = {}, []
        for position, label in enumerate(arg.label for arg in kernel.adj.args):
            if label in ("now", "after", "cached", "stressed", "pose", "step"):
                indices[position] = self.index(others.get(label, label))
                arguments.append(0)
            elif position:
                own = getattr(self if hasattr(self, label) else self._ws, label, None)
                arguments.append(others.get(label, own))
        return Repeated(self._ws.record(kernel, dim, *arguments), indices)
