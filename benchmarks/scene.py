"""A scene of any size for the benchmarks: a soft ball that hits the floor, watched by one camera.

Nothing is read from disk, so that a benchmark needs no results. The ball deforms as the real ones do: particles
change cells and neighbours, Gaussians stretch.
"""

from dataclasses import dataclass

import torch
from torch.nn.functional import gelu

from neuma_lib.coupling.particle_binding import bind
from neuma_lib.coupling.reconstruction import Reconstruction
from neuma_lib.mechanics.analytic import analytic_law
from neuma_lib.mechanics.neural import NeuralLaw, features, neural_law
from neuma_lib.mechanics.singular_values import rotation_and_singular_values
from neuma_lib.sim.colliders import contact_radius
from neuma_lib.sim.model import MPM
from neuma_lib.splatting.cameras import Cameras
from neuma_lib.splatting.gaussians import Gaussians
from neuma_lib.splatting.observation import Observation

DENSITY = 1000.0  # kg/m^3
SOFT = {"elasticity": {"name": "fixed_corotated", "E": 3e4, "nu": 0.3}}
RADIUS = 0.15  # m
FREE_HEIGHT = 0.01  # m above the height at which it touches the floor
VELOCITY = (0.3, -2.0, 0.1)  # m/s


@dataclass(frozen=True)
class Size:
    """How much there is to compute; the defaults are the paper's scale."""

    particles: int = 30_000
    grid: int = 32
    steps: int = 400
    frames: int = 400
    gaussians: int = 20_000
    pixels: int = 800
    dt: float = 5e-4

    @property
    def frame_steps(self) -> tuple[int, ...]:
        """Steps of the frames, evenly up to the last one."""
        return tuple(sorted({max(1, round(self.steps * (i + 1) / self.frames)) for i in range(self.frames)}))


SMALL = Size(particles=2000, grid=24, steps=100, frames=20, gaussians=1500, pixels=96, dt=1e-3)
"""The size of a scene under the default settings on a CPU."""


@dataclass(frozen=True)
class BenchmarkScene:
    """All that a training iteration needs.

    Attributes:
        size: see `Size`.
        model: simulator constants.
        law: a neural law that behaves like a soft solid, with an adaptor of rank 16.
        body: the ball.
        v0: initial velocity [m/s], shape (3,).
        observation: a video of the resting ball: wrong everywhere once it moves, so that every pixel has a gradient.
    """

    size: Size
    model: MPM
    law: NeuralLaw
    body: Reconstruction
    v0: torch.Tensor
    observation: Observation


def make_scene(size: Size, device: torch.device) -> BenchmarkScene:
    """The scene on a device, in float32."""
    generator = torch.Generator().manual_seed(0)
    model = MPM(size.grid, size.dt)
    vol0 = torch.full((size.particles,), 4 / 3 * torch.pi * RADIUS**3 / size.particles)
    low = model.free_range[0] + float(contact_radius(vol0[0]))
    centre = torch.tensor([0.5, low + FREE_HEIGHT + RADIUS, 0.5])
    x0 = centre + RADIUS * _in_unit_ball(size.particles, generator)
    # as a jittered lattice would number them: along lines, so that neighbours in memory are neighbours in space
    x0 = x0[torch.argsort((x0 / model.dx).long() @ torch.tensor([size.grid**2, size.grid, 1]))]
    gaussians = _gaussians(size.gaussians, centre, generator)
    body = Reconstruction(x0, vol0, DENSITY * vol0, gaussians, bind(gaussians.means, gaussians.covars(), x0))
    body = body.to(torch.float32, device)
    cameras = _camera(centre, size.pixels).to(device=device)
    frames = size.frame_steps
    with torch.no_grad():
        eye = torch.eye(3, device=device).expand(1, size.particles, 3, 3)
        image = body.particle_gs(cameras)(body.x0[None], eye)
    rgba = torch.cat(
        [(255 * image.clamp(0, 1)).to(torch.uint8), torch.full_like(image[..., :1], 255).byte()], -1
    )
    observation = Observation(frames, rgba.repeat(len(frames), 1, 1, 1, 1), cameras)
    law = soft_law()
    law.attach_adaptor(rank=16, alpha=16.0)
    law = law.to(device)
    return BenchmarkScene(size, model, law, body, torch.tensor(VELOCITY, device=device), observation)


def soft_law() -> NeuralLaw:
    """A random network whose last layer is fitted to the stress of a soft solid, without plasticity."""
    law = neural_law(seed=3).double()
    W0, W1, _ = (w.detach() for w in law.elasticity.weights())
    noise = torch.randn(4000, 3, 3, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    F = torch.eye(3, dtype=torch.float64) + 0.2 * noise
    R, sigma = rotation_and_singular_values(F)
    X = R.mT @ analytic_law(SOFT, dt=1.0).elasticity(F) @ torch.linalg.inv(F).mT
    hidden = gelu(gelu(features(F, sigma) @ W0.mT) @ W1.mT)
    ridge = 1e-6 * hidden.square().sum() / hidden.shape[1] * torch.eye(hidden.shape[1], dtype=hidden.dtype)
    last = torch.linalg.solve(hidden.mT @ hidden + ridge, hidden.mT @ X.reshape(-1, 9)).mT
    with torch.no_grad():
        law.elasticity.base[-1].copy_(last)
        law.plasticity.base[-1].mul_(1e-2)
    return law.float()


def _in_unit_ball(count: int, generator: torch.Generator, power: float = 1 / 3) -> torch.Tensor:
    """Random points of the unit ball, shape (count, 3): uniform, or with a smaller power nearer to its surface."""
    direction = torch.nn.functional.normalize(torch.randn(count, 3, generator=generator), dim=1)
    return direction * torch.rand(count, 1, generator=generator) ** power


def _gaussians(count: int, centre: torch.Tensor, generator: torch.Generator) -> Gaussians:
    """Kernels of about the size that a fit finds, most of them near the surface."""
    means = centre + RADIUS * _in_unit_ball(count, generator, power=1 / 12)
    spacing = RADIUS * (4 * torch.pi / count) ** 0.5
    scales = spacing * (0.4 + 0.6 * torch.rand(count, 3, generator=generator))
    return Gaussians(
        means=means,
        quats=torch.nn.functional.normalize(torch.randn(count, 4, generator=generator), dim=1),
        scales=scales,
        opacities=0.1 + 0.85 * torch.rand(count, generator=generator),
        sh0=0.5 * torch.randn(count, 1, 3, generator=generator),
        shN=0.05 * torch.randn(count, 15, 3, generator=generator),
    )


def _camera(centre: torch.Tensor, pixels: int) -> Cameras:
    """One frontal view, the ball about 300 px wide of 800."""
    viewmat = torch.eye(4)
    viewmat[1, 1] = viewmat[2, 2] = -1.0
    viewmat[:3, 3] = torch.tensor([-centre[0], centre[1], centre[2] + 1.6])
    focal = 0.375 * pixels * 1.6 / (2 * RADIUS)
    K = torch.tensor([[focal, 0, pixels / 2], [0, focal, pixels / 2], [0, 0, 1]])
    return Cameras(viewmat[None], K[None], pixels, pixels)
