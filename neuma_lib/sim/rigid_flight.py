"""Flight of a spinning body before its first contact in closed form, if its law deforms it negligibly.

Centrifugal stresses of a body of density rho, radius r and spin omega are at most about rho omega^2 r^2 / 2, that of a
rod. A law that is
elastic and bears them at a small strain leaves the body rigid, so its centre moves on a parabola and its rotation
conserves angular momentum.
"""

from collections.abc import Sequence

import torch
from torch import Tensor

from neuma_lib.mechanics.law import Law
from neuma_lib.sim.model import MPM, law_weights
from neuma_lib.sim.state import State, Trajectory, cross_matrix

MAX_STRAIN = 0.01  # strain at which a law must bear the centrifugal stress
_MAX_ANGLE = 0.05  # rotation in a step of the integration [rad]


def is_rigid(law: Law, state: State) -> bool:
    """Whether a body in the rigid motion of `State.rigid` stays rigid in free flight.

    The law must be elastic, without plastic return, up to strains at which its stress exceeds the centrifugal one.
    """
    centre = state.mass @ state.x / state.mass.sum()
    radius, spin = (state.x - centre).norm(dim=1).max(), _spin(state).norm()
    needed = float(state.density.max() * (spin * radius) ** 2 / 2)
    strains = MAX_STRAIN / 2.0 ** torch.arange(8)
    stretches = torch.tensor([[1.0, 0, 0], [1, 1, 1], [1, -0.5, -0.5], [-1, -1, -1]])
    F = torch.diag_embed(1 + strains[:, None, None] * stretches).to(state.x)
    elastic, plastic = law_weights(law, F.dtype)
    flat = F.flatten(0, 1)
    with torch.no_grad():
        tau = law.elasticity.evaluate(flat, elastic).view_as(F)
        change = (law.plasticity.evaluate(flat, plastic).view_as(F) - F).abs()
    bears = tau.abs().amax(dim=(2, 3)).amin(dim=1).cpu() >= needed
    keeps = change.amax(dim=(1, 2, 3)).cpu() <= MAX_STRAIN * strains
    return bool((bears & keeps).any())


def rigid_flight(model: MPM, state: State, steps: Sequence[int], total: bool = False) -> Trajectory:
    """Free flight of a body that stays in the rigid motion of `State.rigid`.

    x_n = c_n + R_n (x0 - c_0) with the parabola c_n of `ballistic` and R' = [omega]_x R, omega = R I^-1 R^T L for the
    inertia I at n = 0 and the constant angular momentum L, by the Runge-Kutta method of fourth order.

    Args:
        state: undeformed particles in rigid motion.
        steps: steps of the returned states, increasing.
        total: whether the total deformation is also returned, equal to F.
    """
    mass, x, v = (value.double().cpu() for value in (state.mass, state.x, state.v.expand_as(state.x)))
    share = mass / mass.sum()
    centre, velocity, spin = share @ x, share @ v, _spin(state).double().cpu()
    arms = x - centre
    moments = (arms * share[:, None]).mT @ arms
    inertia = moments.trace() * torch.eye(3, dtype=torch.float64) - moments
    momentum, inverse = inertia @ spin, torch.linalg.inv(inertia)

    def omega(R: Tensor) -> Tensor:
        return R @ (inverse @ (R.mT @ momentum))

    def rate(R: Tensor) -> Tensor:
        return cross_matrix(omega(R)) @ R

    R, n, rotations = torch.eye(3, dtype=torch.float64), 0, []
    for step in steps:
        seconds = (step - n) * model.dt
        pieces = int(seconds * float(spin.norm()) / _MAX_ANGLE) + 1
        for _ in range(pieces if seconds else 0):
            h = seconds / pieces
            k1 = rate(R)
            k2 = rate(R + h / 2 * k1)
            k3 = rate(R + h / 2 * k2)
            R = R + h / 6 * (k1 + 2 * k2 + 2 * k3 + rate(R + h * k3))
        n = step
        rotations.append(R)
    turns, spins = torch.stack(rotations), torch.stack([cross_matrix(omega(R)) for R in rotations])
    t, g = torch.tensor(steps, dtype=torch.float64)[:, None], torch.tensor(model.gravity, dtype=torch.float64)
    centres = centre + t * model.dt * velocity + model.dt**2 * t * (t + 1) / 2 * g
    arms = arms @ turns.mT
    v = (velocity + t * model.dt * g)[:, None] + arms @ spins.mT
    F, C = (each.to(state.x)[:, None].expand(-1, len(x), 3, 3) for each in (turns, spins))
    x = (centres[:, None] + arms).to(state.x)
    more = {"F_total": F} if total else {}
    if model.contact == "particles":
        more["stuck"] = torch.zeros_like(x)
    return Trajectory(tuple(steps), x, v.to(x), F, C, **more)


def _spin(state: State) -> Tensor:
    """Angular velocity [rad/s] of a rigid motion, shape (3,)."""
    C = state.C[0]
    return torch.stack([C[2, 1] - C[1, 2], C[0, 2] - C[2, 0], C[1, 0] - C[0, 1]]) / 2
