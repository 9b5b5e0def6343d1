"""Laws, particles and motions that the simulator's tests share."""

import math

import torch
from torch.nn.functional import gelu

from neuma_lib.mechanics.analytic import analytic_law
from neuma_lib.mechanics.neural import features, neural_law
from neuma_lib.mechanics.singular_values import rotation_and_singular_values
from neuma_lib.sim.model import CONDITIONS
from neuma_lib.sim.rollout import rollout
from neuma_lib.sim.state import State

DENSITY = 1000.0
DT = 1e-3
BOUNDARIES = [
    *(("particles", condition) for condition in ("no_slip", "slip")),
    *(("nodes", condition) for condition in CONDITIONS),
]
"""Ways of contact, and the conditions of a wall that each has."""


def law_spec(elasticity, plasticity="identity", E=6e4, nu=0.3, **constants):
    """Specification of an analytic law with Young's modulus E [Pa]; ``constants`` are those of the plasticity."""
    return {
        "elasticity": {"name": elasticity, "E": E, "nu": nu},
        "plasticity": {"name": plasticity, **constants},
    }


SPECS = {
    **{
        name: {"elasticity": {"name": name, "E": 5e4, "nu": 0.3}}
        for name in ("fixed_corotated", "stvk", "hencky", "neo_hookean")
    },
    "fluid": law_spec("fluid", "fluid_projection", E=5e4),
    "von_mises": law_spec("hencky", "von_mises", E=5e4, yield_stress=5e2),
    "drucker_prager": law_spec("hencky", "drucker_prager", E=5e4, nu=0.2, friction_angle=30.0),
    "viscous_flow": law_spec("hencky", "viscous_flow", E=5e4, nu=0.4, viscosity=10.0),
}
EVERY_LAW = (*SPECS, "neural")


def make_law(name, dtype=torch.float64):
    """An analytic law by name, or a neural one: a random network whose last layer imitates a soft solid."""
    if name != "neural":
        return analytic_law(SPECS[name], dt=DT, name=name)
    law = neural_law(seed=3).double()
    with torch.no_grad():
        law.elasticity.base[-1].copy_(
            imitate(make_law("fixed_corotated").elasticity, law.elasticity.weights())
        )
    return law.to(dtype)


def imitate(elasticity, weights):
    """Last layer (9, 64) with which tau = R X F^T is nearest to a law's stress at small strains."""
    generator = torch.Generator().manual_seed(1)
    noise = torch.randn(4000, 3, 3, generator=generator, dtype=torch.float64)
    F = torch.eye(3, dtype=torch.float64) + 0.05 * noise
    R, sigma = rotation_and_singular_values(F)
    X = R.mT @ elasticity(F) @ torch.linalg.inv(F).mT
    hidden = gelu(gelu(features(F, sigma) @ weights[0].T) @ weights[1].T)
    return torch.linalg.lstsq(hidden, X.reshape(-1, 9)).solution.T


def cube(count=300, side=0.3, centre=(0.5, 0.5, 0.5), seed=0, dtype=torch.float64):
    """Random particles in a cube: positions [m], masses [kg] and volumes [m^3]."""
    generator = torch.Generator().manual_seed(seed)
    spread = torch.rand(count, 3, generator=generator, dtype=torch.float64) - 0.5
    x = torch.tensor(centre, dtype=torch.float64) + side * spread
    vol0 = torch.full((count,), side**3 / count, dtype=torch.float64)
    return x.to(dtype), (DENSITY * vol0).to(dtype), vol0.to(dtype)


def prism(size, spacing, corner):
    """A block on a regular lattice, with its lowest corner, as a `State` at rest."""
    counts = [round(s / spacing) for s in size]
    ticks = [
        c + s * (torch.arange(n, dtype=torch.float64) + 0.5) / n
        for c, s, n in zip(corner, size, counts, strict=True)
    ]
    x = torch.cartesian_prod(*ticks)
    vol0 = torch.full((len(x),), math.prod(size) / len(x), dtype=torch.float64)
    return State(x, torch.zeros(3).double(), DENSITY * vol0, vol0)


def moving_cube(velocity, **options):
    """Undeformed particles of `cube` with one velocity [m/s]."""
    x, mass, vol0 = cube(**options)
    return State(x, torch.tensor(velocity, dtype=x.dtype), mass, vol0)


def simulate(model, law, start, frames, **options):
    """Rollout up to the last of the frames."""
    return rollout(model, law, start, steps=frames[-1], frames=frames, **options)


def spinning(x, omega=(3.0, -2.0, 5.0), velocity=(0.0, 0.0, 0.0)):
    """Velocities [m/s] and affine velocities [1/s] of a rigid rotation about the mean of x."""
    omega = torch.tensor(omega, dtype=x.dtype)
    spin = torch.linalg.cross(omega.expand(3, 3), torch.eye(3, dtype=x.dtype)).T
    v = (x - x.mean(dim=0)) @ spin.T + torch.tensor(velocity, dtype=x.dtype)
    return v, spin.expand(len(x), 3, 3).contiguous()


def strained(x, seed=0, size=0.05):
    """A random start (v, F, C) with distinct principal stretches, away from the kinks of sorted values."""
    generator = torch.Generator().manual_seed(seed)
    noise = torch.randn(3, len(x), 3, 3, generator=generator, dtype=torch.float64).to(x.dtype)
    Q = torch.linalg.qr(noise[0])[0]
    stretch = torch.diag(torch.tensor([1.1, 1.0, 0.92], dtype=x.dtype))
    F = Q @ stretch @ Q.mT @ (torch.eye(3, dtype=x.dtype) + 0.2 * size * noise[1])
    C = 20 * size * noise[2]
    v = torch.tensor([0.4, -0.6, 0.2], dtype=x.dtype) + size * noise[2, :, 0]
    return v, F, C


def linear_momentum(mass, v):
    """Sum of m v [kg m/s], shape (3,)."""
    return (mass[:, None] * v).sum(dim=0)


def axial(A):
    """Vector a with a x d = (A - A^T) d / 2 for every d, doubled; A (N, 3, 3) -> (N, 3)."""
    return torch.stack([A[:, 2, 1] - A[:, 1, 2], A[:, 0, 2] - A[:, 2, 0], A[:, 1, 0] - A[:, 0, 1]], dim=1)


def angular_momentum(model, mass, x, v, C):
    """Sum of x cross m v and of APIC's part m (dx^2 / 4) axial(C) [kg m^2/s], shape (3,)."""
    orbit = torch.linalg.cross(x, v)
    return (mass[:, None] * (orbit + model.dx**2 / 4 * axial(C))).sum(dim=0)


def loss_of(path):
    """A random linear function of the states of a path, the same in all precisions."""
    generator = torch.Generator().manual_seed(0)
    values = [10 * path.x, path.v, path.F, 0.1 * path.C, path.F_total]
    return sum(
        (torch.randn(value.shape, generator=generator, dtype=torch.float64).to(value.device) * value).sum()
        for value in values
        if value is not None
    )
