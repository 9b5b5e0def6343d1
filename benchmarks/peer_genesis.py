"""Rollout of a case in Genesis, by its public interface: `Scene.step`, and the backward pass of its states.

Genesis allocates a grid for each step that it differentiates, so that forward runs in another scene.
"""

import genesis as gs
import numpy as np
import torch

from benchmarks.peer_engines import Case, Rollout
from neuma_lib.export.materials import engine_material

PADDING = 3  # cells at the walls of its domain that Genesis does not use


class GenesisRollout(Rollout):
    """Rollout of a case: `forward`, and `forward_backward` to the gradient of the initial velocities."""

    def __init__(self, case: Case, device: str):
        if not gs._initialized:
            gs.init(backend=gs.cuda if device == "cuda" else gs.cpu, precision="32", logging_level="error")
        self.case, self.arrays, self.scenes = case, case.arrays(), {}
        self.direction = torch.as_tensor(self.arrays[4], device=gs.device)

    def _started(self, gradient: bool):
        """The scene in its initial state, and its body."""
        if gradient not in self.scenes:
            self.scenes[gradient] = self._built(gradient)
        scene, body, start = self.scenes[gradient]
        scene.reset(start)
        return scene, body

    def _built(self, gradient: bool):
        case, (x, v, _, vol0, _) = self.case, self.arrays
        margin = PADDING / case.grid
        options = dict(requires_grad=True, substeps_local=case.steps + 1) if gradient else {}
        scene = gs.Scene(
            show_viewer=False,
            sim_options=gs.options.SimOptions(dt=case.dt, substeps=1, gravity=case.gravity, **options),
            mpm_options=gs.options.MPMOptions(
                grid_density=case.grid,
                particle_size=vol0 ** (1 / 3),
                lower_bound=(-margin,) * 3,
                upper_bound=(1 + margin,) * 3,
            ),
        )
        material = engine_material(case.spec, 1000.0, case.dt, "genesis")
        kind = getattr(gs.materials.MPM, material.kind.removeprefix("MPM."))
        body = scene.add_entity(gs.morphs.Nowhere(n_particles=len(x)), kind(**material.arguments))
        scene.build()
        body.set_particles_pos(x)
        body.set_particles_vel(v)
        body.set_particles_active(np.ones(len(x), bool))
        return scene, body, scene.get_state()

    def start(self, work: str) -> None:
        self.now = self._started(work == "forward_backward")

    def forward(self) -> None:
        for _ in range(self.case.steps):
            self.now[0].step()

    def forward_backward(self) -> None:
        self.forward()
        state = self.now[1].get_state()
        (state.pos[0] * self.direction).sum().backward()
        self.x = state.pos[0]

    def result(self) -> tuple[np.ndarray, np.ndarray]:
        grad = self.now[0].sim.mpm_solver.particles.grad.vel.to_numpy()[0, :, 0]
        return self.x.detach().cpu().numpy(), grad
