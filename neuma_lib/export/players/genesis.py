"""Play this scene in Genesis (genesis-world): python run.py [STEPS]. Compiles for minutes at first.

Writes motion.npz: positions x (T, N, 3) [m] of the particles at times t [s], y up.
"""

import json
import sys
from pathlib import Path

import genesis as gs
import numpy as np

here = Path(__file__).parent
scene, body = json.loads((here / "scene.json").read_text()), np.load(here / "body.npz")
steps = int(sys.argv[1]) if len(sys.argv) > 1 else scene["steps"]
gs.init(backend=gs.cpu, precision="32", logging_level="warning")
stage = gs.Scene(
    show_viewer=False,
    sim_options=gs.options.SimOptions(dt=scene["dt"], substeps=1, gravity=scene["gravity"]),
    mpm_options=gs.options.MPMOptions(
        grid_density=scene["grid"],
        particle_size=float(body["vol0"].mean() ** (1 / 3)),
        lower_bound=(-0.3, -0.3, -0.3),
        upper_bound=(1.3, 1.3, 1.3),
    ),
)
floor = gs.materials.Rigid(coup_friction=scene["floor"]["friction"], needs_coup=True)
stage.add_entity(gs.morphs.Plane(normal=(0, 1, 0)), floor)
material = getattr(gs.materials.MPM, scene["class"].removeprefix("MPM."))(**scene["arguments"])
particles = stage.add_entity(gs.morphs.Nowhere(n_particles=len(body["x"])), material)
stage.build()
particles.set_particles_pos(body["x"].astype(np.float32))
particles.set_particles_vel(body["v"].astype(np.float32))
particles.set_particles_active(np.ones(len(body["x"]), bool))
t, x = [0.0], [body["x"]]
for step in range(1, steps + 1):
    stage.step()
    if step % scene["every"] == 0 or step == steps:
        t.append(step * scene["dt"])
        x.append(particles.get_particles_pos().cpu().numpy().reshape(-1, 3))
np.savez(here / "motion.npz", t=t, x=np.stack(x).astype(np.float32))
print(f"{steps} steps, mean position {x[-1].mean(axis=0).round(4).tolist()} m: {here / 'motion.npz'}")
