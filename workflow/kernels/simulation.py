"""Kernels of the simulator and of the analytic laws."""

from __future__ import annotations

import torch

from neuma_lib.mechanics.analytic import analytic_law
from neuma_lib.sim.model import MPM
from neuma_lib.sim.rollout import rollout
from neuma_lib.sim.state import State

SPEC = {
    "elasticity": {"name": "hencky", "E": 1e4, "nu": 0.2},
    "plasticity": {"name": "drucker_prager", "friction_angle": 25},
}


def compile_kernels(device: torch.device) -> None:
    """A rollout of two steps with tracers, forward and backward, in both precisions."""
    for dtype in (torch.float32, torch.float64):
        x = 0.4 + 0.2 * torch.rand(16, 3, generator=torch.Generator().manual_seed(0)).to(device, dtype)
        vol0 = torch.full((16,), 1e-4, dtype=dtype, device=device)
        v0 = torch.tensor([0.0, -1.0, 0.0], dtype=dtype, device=device).requires_grad_()
        path = rollout(
            MPM(grid=8, dt=1e-3),
            analytic_law(SPEC),
            State(x, v0, 1e3 * vol0, vol0),
            steps=2,
            frames=(0, 2),
            tracers=x[:2] + 0.01,
            skip_free_flight=False,
        )
        path.x.sum().backward()
