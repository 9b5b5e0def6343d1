"""Play this scene in newton with its USD importer and implicit MPM: python run.py [STEPS].

Writes motion.npz: positions x (T, N, 3) [m] of the particles at times t [s], y up.
"""

import json
import sys
from pathlib import Path

import newton
import numpy as np
from newton.solvers import SolverImplicitMPM
from pxr import Usd

here = Path(__file__).parent
scene = json.loads((here / "scene.json").read_text())
steps = int(sys.argv[1]) if len(sys.argv) > 1 else scene["steps"]
stage = Usd.Stage.Open(str(here / "scene.usda"))
builder = newton.ModelBuilder(up_axis=newton.Axis.Y)
SolverImplicitMPM.register_custom_attributes(builder)
imported = builder.add_usd(stage, load_visual_shapes=False)
model = builder.finalize()
config = SolverImplicitMPM.Config.create_from_usd(stage.GetPrimAtPath(imported["particle_scene_path"]))
solver = SolverImplicitMPM(model, config)
state = model.state()
t, x = [0.0], [state.particle_q.numpy().copy()]
for step in range(1, steps + 1):
    solver.step(state, state, None, None, scene["dt"])
    if step % scene["every"] == 0 or step == steps:
        t.append(step * scene["dt"])
        x.append(state.particle_q.numpy().copy())
np.savez(here / "motion.npz", t=t, x=np.stack(x).astype(np.float32))
print(f"{steps} steps, mean position {x[-1].mean(axis=0).round(4).tolist()} m: {here / 'motion.npz'}")
