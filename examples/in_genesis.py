"""A cube of jelly falls in Genesis and here: pip install genesis-world; python examples/in_genesis.py

Genesis compiles for minutes at first. Both have the same formula. Contact differs, so rebounds do too.
"""

import subprocess
import sys
from pathlib import Path

import numpy as np
import torch

import neuma_lib as nm
from neuma_lib.export.scenes import EngineScene, export_scene

JELLY = {"elasticity": {"name": "neo_hookean", "E": 3e4, "nu": 0.4}}
folder = Path("cube_in_genesis")
cube = EngineScene.falling_cube(density=1000.0, dt=5e-4, seconds=0.4)
for note in export_scene(folder, "genesis", cube, JELLY, {}):
    print("note:", note)
subprocess.run([sys.executable, folder / "run.py"], check=True)
motion = np.load(folder / "motion.npz")

x, v, mass, vol0 = (torch.from_numpy(each) for each in (cube.x, cube.v, cube.mass, cube.vol0))
mpm = nm.MPM(cube.grid, cube.dt, cube.gravity, boundary="slip")
frames = range(0, cube.steps + 1, cube.every)
path = nm.simulate(mpm, nm.Law.from_spec(JELLY), nm.State(x, v, mass, vol0), frames)
for name, t, y in (
    ("Genesis", motion["t"], motion["x"][:, :, 1].mean(axis=1)),
    ("here", np.array(frames) * cube.dt, path.x[:, :, 1].mean(dim=1).numpy()),
):
    print(
        f"{name}: lowest centre {1e3 * y.min():.1f} mm at {t[y.argmin()]:.3f} s, up {np.gradient(y, t).max():.2f} m/s"
    )
