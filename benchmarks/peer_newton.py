"""Rollout of a case in the implicit MPM solver of newton, which has no gradient."""

import newton
import numpy as np
import warp as wp
from newton.solvers import SolverImplicitMPM

from benchmarks.peer_engines import Case, Rollout
from neuma_lib.export.materials import engine_material


class NewtonRollout(Rollout):
    """Rollout of a case with the default tolerance of the solver."""

    def __init__(self, case: Case, device: str):
        x, v, m, vol0, _ = case.arrays()
        builder = newton.ModelBuilder(up_axis=newton.Axis.Y, gravity=case.gravity)
        SolverImplicitMPM.register_custom_attributes(builder)
        material = engine_material(case.spec, 1000.0, case.dt, "newton").arguments
        builder.add_particles(
            pos=[wp.vec3(*row) for row in x.tolist()],
            vel=[wp.vec3(*row) for row in v.tolist()],
            mass=[m] * len(x),
            radius=[vol0 ** (1 / 3) / 2] * len(x),
            custom_attributes={f"mpm:{name}": [value] * len(x) for name, value in material.items()},
        )
        self.model, self.case = builder.finalize(device=device), case
        config = SolverImplicitMPM.Config(voxel_size=1 / case.grid, air_drag=0.0)
        self.solver = SolverImplicitMPM(self.model, config)

    def start(self, work: str) -> None:
        self.state = self.model.state()

    def forward(self) -> None:
        for _ in range(self.case.steps):
            self.solver.step(self.state, self.state, None, None, self.case.dt)

    def result(self) -> tuple[np.ndarray, None]:
        return self.state.particle_q.numpy(), None
