"""Free flight of a spinning body that stays rigid: conservation laws, its simulated twin, and which laws allow it."""

from dataclasses import replace

import pytest
import torch

from neuma_lib.mechanics.analytic import analytic_law
from neuma_lib.sim.model import MPM
from neuma_lib.sim.rigid_flight import MAX_STRAIN, is_rigid, rigid_flight
from neuma_lib.sim.rollout import rollout
from neuma_lib.sim.state import State
from tests.support.sim_scenes import law_spec as law

pytestmark = pytest.mark.core

MODEL = MPM(grid=24, dt=5e-4, contact="particles")
SPIN, VELOCITY = (4.0, -2.0, 3.0), (0.3, 0.5, -0.2)
STEPS = (0, 40, 100, 250)
DENSITY = 1000.0


def body(sides=(0.24, 0.16, 0.1), spin=SPIN) -> State:
    """A block of particles in rigid motion, in the middle of the cube."""
    axes = [torch.arange(-side / 2 + 0.01, side / 2, 0.02, dtype=torch.float64) for side in sides]
    x = torch.cartesian_prod(*axes) + 0.5
    vol0 = torch.full((len(x),), 0.02**3, dtype=torch.float64)
    return State.rigid(x, DENSITY * vol0, vol0, VELOCITY, spin)


def test_momentum_energy_and_distances_are_conserved():
    """The spin of a block about no principal axis changes, its angular momentum and energy do not, to 1e-6 (fourth
    order in steps of 0.05 rad), and the centre moves on the parabola of symplectic Euler."""
    state = body()
    path = rigid_flight(MODEL, state, STEPS, total=True)
    mass, g = state.mass, torch.tensor(MODEL.gravity).double()
    for k, n in enumerate(STEPS):
        x, v = path.x[k], path.v[k]
        fall = n * MODEL.dt * torch.tensor(VELOCITY).double() + MODEL.dt**2 * n * (n + 1) / 2 * g
        centre, velocity = mass @ x / mass.sum(), mass @ v / mass.sum()
        torch.testing.assert_close(centre, mass @ state.x / mass.sum() + fall)
        torch.testing.assert_close(velocity, torch.tensor(VELOCITY).double() + n * MODEL.dt * g)
        momentum, first = (
            (m[:, None] * torch.linalg.cross(x - centre, v - velocity)).sum(0)
            for m, x, v, centre, velocity in (
                (mass, x, v, centre, velocity),
                (mass, path.x[0], path.v[0], state.x.mean(0), path.v[0].mean(0)),
            )
        )
        torch.testing.assert_close(momentum, first, rtol=1e-6, atol=0.0)
        energies = [mass @ each.square().sum(1) for each in (v - velocity, path.v[0] - path.v[0].mean(0))]
        torch.testing.assert_close(*energies, rtol=1e-6, atol=0.0)
        torch.testing.assert_close(torch.cdist(x[:50], x[:50]), torch.cdist(state.x[:50], state.x[:50]))
        torch.testing.assert_close(path.v[k], velocity + (x - centre) @ path.C[k, 0].mT)
        torch.testing.assert_close(path.F[k].mT @ path.F[k], torch.eye(3).double().expand(len(x), 3, 3))
    assert path.F_total is path.F and not path.stuck.any()
    turned = (path.C[-1, 0] - path.C[0, 0]).norm() / path.C[0, 0].norm()
    assert turned > 0.1


def test_a_stiff_cube_flies_as_simulated():
    """Its inertia is isotropic, so that the inertia of the grid's affine velocities changes nothing. Strains of the
    simulation are at most rho spin^2 r^2 / (2 E), and so are relative distances."""
    state, E = body((0.16, 0.16, 0.16)), 2e6
    simulated = rollout(MODEL, analytic_law(law("hencky", E=E, nu=0.3)), state, steps=STEPS[-1], frames=STEPS)
    path = rigid_flight(MODEL, state, STEPS)
    radius = float((state.x - 0.5).norm(dim=1).max())
    strain = DENSITY * torch.tensor(SPIN).square().sum() * radius**2 / 2 / E
    difference = (path.x - simulated.x).norm(dim=-1).amax(dim=-1)
    assert (difference <= 5 * strain * radius).all() and difference[-1] < 1e-4


def test_laws_that_bear_the_spin_elastically_stay_rigid():
    """Up to the largest strain, at a yield stress above the centrifugal one, and never if the material flows freely."""
    state = body()
    radius = float((state.x - 0.5).norm(dim=1).max())
    stress = DENSITY * float(torch.tensor(SPIN).square().sum()) * radius**2 / 2
    stiff = {"E": 10 * stress / MAX_STRAIN, "nu": 0.3}
    rigid = {
        "stiff": law("hencky", **stiff),
        "yields late": law("hencky", "von_mises", **stiff, yield_stress=10 * stress),
    }
    loose = {
        "soft": law("hencky", E=0.1 * stress / MAX_STRAIN, nu=0.3),
        "yields early": law("hencky", "von_mises", **stiff, yield_stress=0.1 * stress),
        "sand": law("hencky", "drucker_prager", **stiff, friction_angle=40),
        "fluid": law("hencky", "viscous_flow", **stiff, viscosity=100),
    }
    for name, spec in (rigid | loose).items():
        assert is_rigid(analytic_law(spec, dt=MODEL.dt), state) == (name in rigid), name
    slow = body(spin=tuple(0.05 * w for w in SPIN))
    assert is_rigid(analytic_law(loose["soft"]), slow)
    single = replace(
        state,
        **{name: getattr(state, name).float() for name in ("x", "v", "mass", "vol0", "F", "C", "stuck")},
    )
    assert is_rigid(analytic_law(rigid["stiff"]), single)


@pytest.mark.parametrize("strained", ["one axis", "expanded", "sheared", "compressed"])
def test_a_law_is_rigid_in_every_direction(strained):
    """A law that flows, or bears nothing, in one of them is not."""

    def applies(F):
        strain = F.diagonal(dim1=-2, dim2=-1) - 1
        longer, shorter = (strain > 0).sum(-1), (strain < 0).sum(-1)
        count = {"one axis": (1, 0), "expanded": (3, 0), "sheared": (1, 2), "compressed": (0, 3)}[strained]
        return ((longer == count[0]) & (shorter == count[1]))[:, None, None]

    def stiff():
        return analytic_law(law("hencky", E=1e9, nu=0.3))

    state, flows, gives = body(), stiff(), stiff()
    assert is_rigid(flows, state)
    flows.plasticity.evaluate = lambda F, weights: torch.where(applies(F), torch.eye(3).to(F), F)
    assert not is_rigid(flows, state)
    stress = gives.elasticity.evaluate
    gives.elasticity.evaluate = lambda F, weights: torch.where(applies(F), 0.0, stress(F, weights))
    assert not is_rigid(gives, state)
