"""The force of a stretched rubber cube in MuJoCo, and of its law: make engines; python examples/in_mujoco.py"""

import mujoco
import torch

import neuma_lib as nm
from neuma_lib.cli import main

RUBBER = {"elasticity": {"name": "stvk", "E": 3e4, "nu": 0.3}}
law = nm.Law.from_spec(RUBBER)
law.save("rubber.safetensors", {"density": 1000.0, "dt": None})
assert (
    main(["law", "export", "rubber.safetensors", "rubber.xml", "--engine", "mujoco", "--substep", "5e-4"])
    == 0
)

model = mujoco.MjModel.from_xml_path("rubber.xml")
data = mujoco.MjData(model)
start = model.body_pos[1:]  # a cube with edges of 0.2 m
end = start[:, 0] > start[:, 0].max() - 1e-9
for stretch in (0.7, 0.8, 0.9, 1.1, 1.2):
    data.qpos[:] = ((stretch - 1) * (start - start.min(axis=0)) * [1, 0, 0]).ravel()  # sides held
    mujoco.mj_forward(model, data)
    force = -data.qfrc_passive.reshape(-1, 3)[end, 0].sum()
    F = torch.diag(torch.tensor([stretch, 1.0, 1.0], dtype=torch.float64))[None]
    stress = float(law.first_piola(F)[0, 0, 0])
    print(f"stretch {stretch}: MuJoCo {force:+.6f} N, law {stress * 0.2**2:+.6f} N")
