"""Kernels of the simulator and of the analytic laws."""

import torch

from neuma_lib.mechanics.analytic import analytic_law
from neuma_lib.mechanics.law import Law
from neuma_lib.sim.model import MPM
from neuma_lib.sim.rollout import rollout
from neuma_lib.sim.state import State

SPEC = {
    "elasticity": {"name": "hencky", "E": 1e4, "nu": 0.2},
    "plasticity": {"name": "drucker_prager", "friction_angle": 25},
}


def compile_kernels(device: torch.device) -> None:
    """A rollout of an analytic law, all of which share kernels, without gradient."""
    simulate(analytic_law(SPEC), device)


def simulate(law: Law, device: torch.device, gradient: bool = False) -> None:
    """Simulate two steps with tracers in single precision, the precision of the workflow."""
    x = (0.4 + 0.2 * torch.rand(16, 3, generator=torch.Generator().manual_seed(0))).to(device)
    vol0 = torch.full((16,), 1e-4, device=device)
    v0 = torch.tensor([0.0, -1.0, 0.0], device=device, requires_grad=gradient)
    path = rollout(
        MPM(grid=8, dt=1e-3),
        law.to(device),
        State(x, v0, 1e3 * vol0, vol0),
        steps=2,
        frames=(0, 2),
        tracers=None if gradient else x[:2] + 0.01,
        skip_free_flight=False,
    )
    if gradient:
        path.x.sum().backward()
