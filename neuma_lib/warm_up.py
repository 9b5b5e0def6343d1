"""Compile the Warp kernels of simulator, laws and renderer once, by using each of them on a handful of particles.

Two processes that start at the same time would otherwise compile the same kernels twice.
"""

from __future__ import annotations

from collections.abc import Callable

import torch

from neuma_lib.binding import bind
from neuma_lib.materials import analytic_law
from neuma_lib.materials.neural import neural_law
from neuma_lib.render.cameras import Cameras, look_at
from neuma_lib.render.gaussians import Gaussians
from neuma_lib.render.particle_gs import ParticleGS
from neuma_lib.sim import MPMModel, rollout

PRECISIONS = (torch.float32, torch.float64)


def compile_kernels(device: torch.device, progress: Callable[[int, int], None] | None = None) -> int:
    """Run every kernel once, in both precisions, forward and backward. Returns the number of pieces run."""
    pieces = [
        (work, dtype) for dtype in PRECISIONS for work in (_analytic_rollout, _neural_rollout, _rendering)
    ]
    for done, (work, dtype) in enumerate(pieces):
        work(dtype, device)
        if progress:
            progress(done + 1, len(pieces))
    return len(pieces)


def _rollout(law, dtype: torch.dtype, device: torch.device):
    x = 0.4 + 0.2 * torch.rand(16, 3, generator=torch.Generator().manual_seed(0)).to(device, dtype)
    vol0 = torch.full((16,), 1e-4, dtype=dtype, device=device)
    velocity = torch.tensor([0.0, -1.0, 0.0], dtype=dtype, device=device).requires_grad_()
    model = MPMModel(grid=8, dt=1e-3)
    tracers = x[:2] + 0.01
    return rollout(
        model,
        law,
        x,
        velocity,
        1e3 * vol0,
        vol0,
        steps=2,
        frames=(0, 2),
        tracers=tracers,
        skip_free_flight=False,
    )


def _analytic_rollout(dtype: torch.dtype, device: torch.device) -> None:
    plasticity = {"name": "drucker_prager", "friction_angle": 25}
    spec = {"elasticity": {"name": "hencky", "E": 1e4, "nu": 0.2}, "plasticity": plasticity}
    _rollout(analytic_law(spec), dtype, device).x.sum().backward()


def _neural_rollout(dtype: torch.dtype, device: torch.device) -> None:
    law = neural_law().to(device, dtype)
    law.attach_adaptor(rank=2)
    _rollout(law, dtype, device).x.sum().backward()


def _rendering(dtype: torch.dtype, device: torch.device) -> None:
    generator = torch.Generator().manual_seed(0)
    means = 0.4 + 0.2 * torch.rand(4, 3, generator=generator)
    gaussians = Gaussians(
        means,
        torch.eye(4),
        torch.full((4, 3), 0.05),
        torch.full((4,), 0.5),
        torch.zeros(4, 1, 3),
        torch.zeros(4, 3, 3),
    ).to(device, dtype)
    eyes, up = torch.tensor([[0.5, 0.5, 2.0]]), torch.tensor([0.0, 1.0, 0.0])
    K = torch.tensor([[[16.0, 0.0, 8.0], [0.0, 16.0, 8.0], [0.0, 0.0, 1.0]]])
    cameras = Cameras(look_at(eyes, torch.full((3,), 0.5), up), K, 16, 16).to(device, dtype)
    binding = bind(gaussians.means, gaussians.covars(), gaussians.means)
    x = gaussians.means[None].clone().requires_grad_()
    F = torch.eye(3, dtype=dtype, device=device).expand(1, 4, 3, 3).clone().requires_grad_()
    ParticleGS(gaussians, binding, gaussians.means, cameras)(x, F).sum().backward()
