"""A small grounding problem without files: a soft ball or block that a camera watches, with its motion known."""

import torch

from neuma_lib.coupling.particle_binding import bind_two_pass
from neuma_lib.coupling.reconstruction import Reconstruction
from neuma_lib.mechanics.analytic import analytic_law
from neuma_lib.sim.model import MPM
from neuma_lib.sim.rollout import rollout
from neuma_lib.splatting.cameras import Cameras, look_at
from neuma_lib.splatting.gaussians import Gaussians
from neuma_lib.splatting.observation import Observation

MODEL = MPM(grid=16, dt=2e-3)
TRUTH = {"elasticity": {"name": "fixed_corotated", "E": 3e4, "nu": 0.3}, "plasticity": {"name": "identity"}}
PRIOR = {"elasticity": {"name": "fixed_corotated", "E": 1e5, "nu": 0.2}, "plasticity": {"name": "identity"}}
RADIUS = 0.13
HEIGHT = 0.28  # of the centre of the ball at the start [m]


def ball(
    height: float = HEIGHT, count: int = 300, n_gaussians: int = 120, seed: int = 0, dtype=torch.float64
):
    """A ball of particles with coloured Gaussians on and in it."""
    g = torch.Generator().manual_seed(seed)

    def inside(n):
        direction = torch.randn(n, 3, generator=g, dtype=torch.float64)
        radius = RADIUS * torch.rand(n, 1, generator=g, dtype=torch.float64) ** (1 / 3)
        return torch.tensor([0.5, height, 0.5], dtype=torch.float64) + radius * direction / direction.norm(
            dim=1, keepdim=True
        )

    return _body(inside, 4 / 3 * torch.pi * RADIUS**3, count, n_gaussians, g, dtype)


def block(count: int = 300, n_gaussians: int = 120, seed: int = 0, dtype=torch.float64):
    """A flat block 2 cm above the floor, which slides if it is launched to the side."""
    g, size = torch.Generator().manual_seed(seed), torch.tensor([0.24, 0.12, 0.24], dtype=torch.float64)

    def inside(n):
        return torch.tensor([0.4, 0.08, 0.5]) + size * (
            torch.rand(n, 3, generator=g, dtype=torch.float64) - 0.5
        )

    return _body(inside, float(size.prod()), count, n_gaussians, g, dtype)


def _body(inside, volume, count, n_gaussians, g, dtype):
    """Particles and coloured Gaussians at the points that `inside` draws."""
    gaussians = Gaussians(
        means=inside(n_gaussians),
        quats=torch.tensor([1.0, 0, 0, 0], dtype=torch.float64).repeat(n_gaussians, 1),
        scales=torch.full((n_gaussians, 3), 0.022, dtype=torch.float64),
        opacities=torch.full((n_gaussians,), 0.7, dtype=torch.float64),
        sh0=1.5 * torch.randn(n_gaussians, 1, 3, generator=g, dtype=torch.float64),
        shN=torch.zeros(n_gaussians, 0, 3, dtype=torch.float64),
    )
    particles = inside(count)
    binding, x0, _, vol0 = bind_two_pass(gaussians.means, gaussians.covars(), particles, volume / count)
    return Reconstruction(x0, vol0, 1000 * vol0, gaussians, binding).to(dtype)


def camera(size: int = 32, dtype=torch.float64) -> Cameras:
    """One frontal view of the whole fall."""
    eye = torch.tensor([[0.5, 0.3, 2.0]], dtype=dtype)
    view = look_at(
        eye, torch.tensor([0.5, 0.25, 0.5], dtype=dtype), torch.tensor([0.0, 1.0, 0.0], dtype=dtype)
    )
    f = 1.8 * size
    K = torch.tensor([[[f, 0, size / 2], [0, f, size / 2], [0, 0, 1]]], dtype=dtype)
    return Cameras(view, K, size, size)


def observe(
    body: Reconstruction, v0, frames, spec=TRUTH, model=MODEL, size: int = 32, spin=(0.0, 0.0, 0.0)
) -> Observation:
    """Video of the ball under an analytic law, made where the ball is."""
    cameras = camera(size, body.x0.dtype).to(body.x0.device)
    with torch.no_grad():
        path = rollout(
            model,
            analytic_law(spec, model.dt).to(body.x0.device),
            body.state(v0, spin),
            steps=frames[-1],
            frames=frames,
        )
        return Observation(tuple(frames), body.particle_gs(cameras)(path.x, path.F), cameras)
