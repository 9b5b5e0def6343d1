"""Balls against the walls: no particle leaves the grid, the shape recovers, and the position at rest."""

import math

import pytest
import torch

from neuma_lib.errors import NonFiniteError
from neuma_lib.mechanics.analytic import analytic_law
from neuma_lib.sim.colliders import CONTACT_STIFFNESS, contact_radius
from neuma_lib.sim.model import MPM, WALLS
from neuma_lib.sim.rollout import rollout
from neuma_lib.sim.state import State
from tests.support.errors import refused
from tests.support.sim_scenes import BOUNDARIES, DENSITY

pytestmark = pytest.mark.core

RADIUS = 0.13
SOFT = {"elasticity": {"name": "fixed_corotated", "E": 3e4, "nu": 0.45}}  # the softest body of the benchmarks
DT = 5e-4
WEIGHTLESS = (0.0, 0.0, 0.0)


def ball(grid: int, centre: tuple[float, float, float]) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Eight particles a cell on a jittered lattice: positions [m], masses [kg], volumes [m^3]."""
    spacing = 0.5 / grid
    reach = math.ceil(RADIUS / spacing)
    ticks = spacing * (torch.arange(-reach, reach) + 0.5)
    x = torch.cartesian_prod(ticks, ticks, ticks)
    x = x + 0.5 * spacing * (torch.rand(x.shape, generator=torch.Generator().manual_seed(0)) - 0.5)
    x = x[x.norm(dim=1) < RADIUS - 0.25 * spacing]
    vol0 = torch.full((len(x),), 4 / 3 * math.pi * RADIUS**3 / len(x))
    return x + torch.tensor(centre), DENSITY * vol0, vol0


def before(wall: str, gap: float) -> tuple[list[float], torch.Tensor]:
    """Centre of a ball whose surface is at this distance from a wall of the cube [m], and the way there (3,)."""
    axis, upper = divmod(WALLS.index(wall), 2)
    centre, towards = [0.5, 0.5, 0.5], torch.zeros(3)
    centre[axis] = 1 - RADIUS - gap if upper else RADIUS + gap
    towards[axis] = 1.0 if upper else -1.0
    return centre, towards


def largest_error(x: torch.Tensor, start: torch.Tensor) -> float:
    """Largest distance [m] of a particle from its place at the start, after the best rigid motion."""
    a, b = (points.double() - points.double().mean(dim=0) for points in (x, start))
    U, _, Vh = torch.linalg.svd(a.mT @ b)
    mirrored = torch.ones(3, dtype=a.dtype)
    mirrored[2] = torch.linalg.det(U @ Vh)
    return float((a @ U @ torch.diag(mirrored) @ Vh - b).norm(dim=1).max())


@pytest.mark.parametrize(
    "wall, condition, contact",
    [
        *((wall, "no_slip", contact) for contact in ("particles", "nodes") for wall in WALLS),
        *(("y_min", "slip", contact) for contact in ("particles", "nodes")),
        ("y_min", "no_slip", "released"),
    ],
)
def test_a_ball_recovers_its_shape(wall, condition, contact):
    """At rest again, no particle of a soft ball that hit a wall is displaced by more than 1 % of the radius.

    On a wall without friction, contact of particles leaves 1.9 % (1.6 % on 36^3). Squeezed to half its height it
    vibrates after the bounce, so it is stopped there and the vibration decays. The remaining error is permanent: a
    tenth of the radius with released walls.
    """
    model = MPM(24, DT, gravity=WEIGHTLESS, boundary=condition, contact=contact)
    centre, towards = before(wall, 0.08)
    x0, mass, vol0 = ball(model.grid, centre)
    law = analytic_law(SOFT, dt=DT)
    path = rollout(model, law, State(x0, 2.5 * towards, mass, vol0), steps=500, frames=(200, 500))
    assert ((path.x[0] - x0) @ towards).min() > 0.05  # contact
    x, F = path.x[1], path.F[1]
    assert (x.mean(dim=0) - path.x[0].mean(dim=0)) @ towards < 0
    aside = x - x.mean(dim=0) + 0.5
    still = State(aside, torch.zeros(3), mass, vol0, F, torch.zeros_like(F))
    rested = rollout(model, law, still, steps=1000, frames=(1000,), skip_free_flight=False)
    error = largest_error(rested.x[0], x0)
    slides = (condition, contact) == ("slip", "particles")
    limit = 0.025 if slides else 0.01
    assert error > 0.05 * RADIUS if contact == "released" else error < limit * RADIUS


@pytest.mark.parametrize("contact, condition", BOUNDARIES)
@pytest.mark.parametrize("wall", WALLS)
def test_a_fast_impact_leaves_no_particle_outside(wall, contact, condition):
    """Launched at 8 m/s, over four times the speed of its shear waves, obliquely into a corner of walls.

    No particle in contact of particles goes more than a quarter of a cell beyond a face. Nodes stop it later: half a
    cell beyond the first wall node the velocity is zero, whatever the body does: there a particle sees wall
    nodes only. Its distance d from there, in cells, shrinks in a step by d^2 / 2 times the cells that the nearest free
    node moves, so it stays positive.
    """
    model = MPM(16, DT, gravity=WEIGHTLESS, boundary=condition, contact=contact)
    centre, towards = before(wall, 0.05)
    x0, mass, vol0 = ball(model.grid, centre)
    aside = (1 - towards.abs()) * torch.tensor([3.0, 2.0, -2.0])
    law = analytic_law({"elasticity": {"name": "hencky", "E": 1e4, "nu": 0.3}}, dt=DT)
    path = rollout(model, law, State(x0, 8 * towards + aside, mass, vol0), steps=400, frames=range(0, 401, 4))
    low, high = model.stencil_range
    assert (low, high) == (-1.5 * model.dx, 1 + 1.5 * model.dx)
    assert low < path.x.min() and path.x.max() < high
    assert not ((path.x == low) | (path.x == high)).any()
    if contact == "particles":
        assert -0.25 * model.dx < path.x.min() and path.x.max() < 1 + 0.25 * model.dx
    if condition != "sticky":
        ahead = (path.x[-1] - 0.5) @ towards
        assert ahead.max() < 0.5


def test_a_particle_outside_the_grid_is_an_error():
    """The message names a particle whose affine velocity moves a node further than the particle's velocity."""
    model = MPM(16, DT, gravity=WEIGHTLESS, boundary="sticky", contact="nodes")
    x = torch.tensor([[0.5, 0.5, 0.5], [0.5, -model.dx, 0.5]])
    C = torch.zeros(2, 3, 3)
    # the free node above moves down by five cells, and the particle with an eighth of it
    C[1, 1, 1] = -5 / DT
    one = torch.full((2,), 1e-3)
    law = analytic_law(SOFT, dt=DT)
    with pytest.raises(NonFiniteError, match="particle 1 .* left the grid at step 1") as error:
        rollout(model, law, State(x, torch.zeros(3), one, one, C=C), steps=2, frames=(2,))
    assert (error.value.step, error.value.particle) == (1, 1)


@pytest.mark.parametrize("wall", ["y_min", "x_max"])
@pytest.mark.parametrize("E, fraction", [(3e4, 0.4), (1e6, 0.2)])
@pytest.mark.parametrize("contact", ["particles", "nodes"])
def test_bodies_rest_at_the_wall_of_the_cube(contact, wall, E, fraction):
    """Half of the fraction of a cell is the depth of the surface with contact of particles.

    With contact of nodes, the fraction is that of the particle next to the wall: a soft ball sinks a third of a cell
    deep. With contact of particles of mass m and penetrations p_i, the change of momentum is that by the weight M g and
    the forces of the particles: d(M v)/dt = M g - sum(alpha m p_i / dt^2). A bounce is left after 0.3 s.
    """
    towards = before(wall, 0.0)[1]
    for grid in (16, 24):
        dt = 0.3 / (grid * math.sqrt(2.5 * E / DENSITY))
        model = MPM(grid, dt, gravity=tuple(9.8 * towards.tolist()[a] for a in range(3)), contact=contact)
        x0, mass, vol0 = ball(grid, before(wall, model.free_range[0])[0])
        law = analytic_law({"elasticity": {"name": "fixed_corotated", "E": E, "nu": 0.4}}, dt=dt)
        steps = round(0.6 / dt)
        path = rollout(
            model, law, State(x0, torch.zeros(3), mass, vol0), steps=steps, frames=range(steps // 2, steps)
        )
        depth = (path.x - 0.5) @ towards - 0.5
        if contact == "nodes":
            assert abs(float(depth.amax(dim=1).mean())) < fraction * model.dx
            continue
        penetration = (depth + contact_radius(vol0)).clamp(min=0)
        assert 0 < float(penetration.amax(dim=1).mean()) < 0.5 * fraction * model.dx
        impulse = CONTACT_STIFFNESS / dt * float(mass[0] * penetration[:-1].sum())
        weight = 9.8 * dt * (len(path.x) - 1) * float(mass.sum())
        gained = float(mass @ ((path.v[-1] - path.v[0]) @ towards))
        assert gained == pytest.approx(weight - impulse, abs=1e-3 * weight)


def bounce(grid: int, contact: str, E: float = 3e4) -> tuple[float, float]:
    """Lowest place of a falling ball [cells], and height to which its centre rebounds [m].

    The place is that of the surface with contact of particles, and else that of a particle's centre. With contact of
    particles the time step is a fraction of the cell, because the depth of an impact is proportional to it.
    """
    dt = 16 * DT / grid if contact == "particles" else DT
    model = MPM(grid, dt, contact=contact)
    x0, mass, vol0 = ball(grid, (0.5, RADIUS + 0.15, 0.5))
    state = State(x0, torch.tensor([0.0, -1.92, 0.0]), mass, vol0)
    law = analytic_law({"elasticity": {"name": "fixed_corotated", "E": E, "nu": 0.45}}, dt=dt)
    every = round(4 * DT / dt)
    path = rollout(model, law, state, steps=225 * every, frames=range(0, 225 * every + 1, every))
    y, v = path.x[..., 1], path.v[..., 1].mean(dim=1)
    up = int((v > 0).int().argmax())
    top = up + int((v[up:] < 0).int().argmax())
    radius = float(contact_radius(vol0)[0]) if contact == "particles" else 0.0
    return (float(y[:top].min()) - radius) * grid, float(y[top].mean())


DEEPEST = {"particles": -0.25, "nodes": -0.75}  # bound of the lowest place of `bounce` [cells]


@pytest.mark.parametrize("contact", DEEPEST)
def test_coarse_grids_meet_the_same_floor(contact):
    """How deep a body goes below y = 0 is a fraction of a cell, the same at both sizes; the finer one loses less."""
    (low, height), (lower, higher) = bounce(16, contact), bounce(24, contact)
    assert DEEPEST[contact] < low < 0 and abs(low - lower) < 0.05
    assert height < higher


@pytest.mark.slow
@pytest.mark.parametrize(
    "contact, E, rate",
    [("particles", 3e4, 1.0), ("particles", 1e5, 1.0), ("nodes", 3e4, 1.0), ("nodes", 1e5, 0.5)],
)
def test_the_rebound_converges_to_the_same_floor(contact, E, rate):
    """Twice as fine a grid changes the height less than the doubling before it did, and with nodes half as much (first
    order) for a ball that is not squeezed to half its height. Lowest places are one fraction of a cell, so they go to
    y = 0.
    """
    grids = (24, 32, 48, 64, 96) if contact == "particles" else (16, 24, 32, 48, 64)
    lows, heights = zip(*(bounce(grid, contact, E) for grid in grids), strict=True)
    assert max(lows) - min(lows) < 0.06 and DEEPEST[contact] < min(lows)
    assert all(a < b for a, b in zip(heights, heights[1:], strict=False))
    assert heights[4] - heights[2] < rate * (heights[2] - heights[0])
    assert heights[4] - heights[3] < heights[3] - heights[2]


def test_particles_that_start_outside_are_counted_and_the_first_is_named():
    model = MPM(16, DT)
    low, high = model.stencil_range
    x = torch.full((5, 3), 0.5)
    x[2, 1], x[4, 0] = high + 0.01, low - 0.01
    one = torch.full((5,), 1e-3)
    problem = f"2 of 5 particles start outside the grid (first: 2, at 0.5, {high + 0.01:.4g}, 0.5 m)"
    with refused("state.x", problem=problem, remedy=f"[{low:.4g}, {high:.4g}] m"):
        rollout(model, analytic_law(SOFT, dt=DT), State(x, torch.zeros(3), one, one), steps=2, frames=(2,))
