"""Play this scene in MuJoCo: python run.py [STEPS].

Writes motion.npz: positions x (T, N, 3) [m] of the vertices of the mesh at times t [s], y up, and their masses [kg].
"""

import json
import sys
from pathlib import Path

import mujoco
import numpy as np

here = Path(__file__).parent
scene, body = json.loads((here / "scene.json").read_text()), np.load(here / "body.npz")
steps = int(sys.argv[1]) if len(sys.argv) > 1 else scene["steps"]
model = mujoco.MjModel.from_xml_path(str(here / "scene.xml"))
data = mujoco.MjData(model)
data.qvel[:] = body["v"].ravel()  # three slides for each vertex
start = model.body_pos[1:]
t, x = [0.0], [start]
for step in range(1, steps + 1):
    mujoco.mj_step(model, data)
    if step % scene["every"] == 0 or step == steps:
        t.append(step * scene["dt"])
        x.append(start + data.qpos.reshape(-1, 3))
if data.warning[mujoco.mjtWarning.mjWARN_BADQACC].number:
    sys.exit("MuJoCo became unstable. Reduce dt in scene.json and timestep in scene.xml")
masses = model.body_mass[1:]
np.savez(here / "motion.npz", t=t, x=np.stack(x).astype(np.float32), masses=masses)
print(
    f"{steps} steps, mean position {(masses @ x[-1] / masses.sum()).round(4).tolist()} m: {here / 'motion.npz'}"
)
