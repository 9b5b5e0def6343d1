"""Clay from a law's file in newton, by its own USD importer: make engines; python examples/in_newton.py

newton has the same formula. It compiles for a minute at first.
"""

import newton
from newton.solvers import SolverImplicitMPM
from pxr import Usd

import neuma_lib as nm
from neuma_lib.cli import main

CLAY = {
    "elasticity": {"name": "hencky", "E": 1e5, "nu": 0.3},
    "plasticity": {"name": "von_mises", "yield_stress": 2e3},
}
nm.Law.from_spec(CLAY).save("clay.safetensors", {"density": 1500.0, "dt": None})
assert main(["law", "export", "clay.safetensors", "clay.usda", "--engine", "usd", "--substep", "2e-3"]) == 0

stage = Usd.Stage.Open("clay.usda")
builder = newton.ModelBuilder(up_axis=newton.Axis.Y)
SolverImplicitMPM.register_custom_attributes(builder)
scene = builder.add_usd(stage, load_visual_shapes=False)["particle_scene_path"]
model = builder.finalize()
solver = SolverImplicitMPM(model, SolverImplicitMPM.Config.create_from_usd(stage.GetPrimAtPath(scene)))
state = model.state()
for step in range(120):
    solver.step(state, state, None, None, 2e-3)
    if step % 20 == 19:
        y = state.particle_q.numpy()[:, 1]
        print(
            f"{2e-3 * (step + 1):.2f} s: mean height {1e3 * y.mean():.0f} mm, lowest point {1e3 * y.min():.1f} mm"
        )
