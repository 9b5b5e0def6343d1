"""The simulator against conservation laws and closed forms, at its walls, and on input it must refuse."""

import math

import pytest
import torch

from neuma_lib.errors import InputError, NonFiniteError
from neuma_lib.mechanics.analytic import analytic_law
from neuma_lib.mechanics.law import Law, Plasticity
from neuma_lib.sim.free_flight import free_flight_steps
from neuma_lib.sim.model import MPM, WALLS, MaterialRegion, as_regions, consecutive, contact_clearance
from neuma_lib.sim.rollout import rollout
from neuma_lib.sim.state import State, cross_matrix
from neuma_lib.sim.workspace import Workspace, WorkspaceSize
from tests.support.errors import refused
from tests.support.sim_scenes import (
    BOUNDARIES,
    DENSITY,
    DT,
    EVERY_LAW,
    angular_momentum,
    axial,
    cube,
    linear_momentum,
    make_law,
    moving_cube,
    simulate,
    spinning,
    strained,
)

pytestmark = pytest.mark.core

WEIGHTLESS = MPM(16, DT, gravity=(0.0, 0.0, 0.0))
EPS = {torch.float32: 1.2e-7, torch.float64: 2.2e-16}


@pytest.mark.parametrize("skip", [True, False], ids=["skipped", "simulated"])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64], ids=["float32", "float64"])
@pytest.mark.parametrize("name", EVERY_LAW)
def test_free_fall(name, dtype, skip):
    """x_n = x0 + v0 n dt + g dt^2 n (n + 1) / 2 and F = I, to round-off, in every frame."""
    model = MPM(16, DT, gravity=(1.0, -9.8, 0.5))
    start, frames = moving_cube((0.3, 0.8, -0.2), dtype=dtype), (0, 1, 17, 60)
    path = simulate(model, make_law(name, dtype), start, frames, skip_free_flight=skip)
    x0, v0 = start.x.double(), start.v.double()
    n = torch.tensor(frames, dtype=torch.float64)[:, None, None]
    gravity = torch.tensor(model.gravity, dtype=torch.float64)
    fallen = x0 + v0 * n * DT + gravity * DT**2 * n * (n + 1) / 2
    assert contact_clearance(model, fallen, start.vol0.double()).min() > 0
    # n steps add at most n roundings of numbers below 1; F sees velocities over a cell, dt / dx.
    assert (path.x.double() - fallen).abs().max() < 60 * EPS[dtype]
    assert (path.v.double() - v0 - gravity * DT * n).abs().max() < 60 * 4 * EPS[dtype]
    assert (path.F.double() - torch.eye(3)).abs().max() < 60 * 16 * EPS[dtype]


@pytest.mark.parametrize("scatter", ["native", "atomic"])
def test_p2g_conserves_mass_and_momentum(scatter):
    """Whatever C and tau are: the weights sum to 1 and the weighted offsets to 0."""
    x, mass, vol0 = cube(side=0.5)
    v, _, C = strained(x)
    ws = Workspace(WorkspaceSize(WEIGHTLESS, len(x), x.dtype, x.device, scatter=scatter))
    for buffer, value in ((ws.x, x), (ws.v, v), (ws.C, C), (ws.tau, 1e4 * C)):
        buffer[0].copy_(value)
    ws.mass.copy_(mass)
    ws.vol0.copy_(vol0)
    ws.transfer_to_grid(0)
    total = ws.grid[0].sum(dim=0)
    torch.testing.assert_close(total[3], mass.sum(), rtol=1e-13, atol=0)
    torch.testing.assert_close(total[:3], linear_momentum(mass, v), rtol=1e-10, atol=1e-12)


@pytest.mark.parametrize("name", EVERY_LAW)
def test_momenta_of_a_spinning_cube(name):
    """Linear momentum stays; the angular one changes by -dt sum vol0 axial(tau) a step. Both hold to round-off.

    P2G adds -dt vol0 (4/dx^2) w_i tau d_i to node i, and sum_i w_i d_i d_i^T = dx^2/4 I. The stress of an analytic
    law is symmetric, that of a network, R X F^T, is not quite.
    """
    steps, law = 100, make_law(name)
    x0, mass, vol0 = cube(side=0.25)
    v0, C0 = spinning(x0, omega=(8.0, -5.0, 10.0), velocity=(0.2, -0.1, 0.3))
    F0 = torch.linalg.matrix_exp(0.03 * torch.tensor([[1.0, 0.5, 0], [0.5, -1.5, 0], [0, 0, 0.5]]).double())
    state = State(x0, v0, mass, vol0, F0.expand(len(x0), 3, 3), C0)
    path = simulate(WEIGHTLESS, law, state, range(steps + 1))
    assert contact_clearance(WEIGHTLESS, path.x, vol0).min() > 0
    assert (path.F[-1] - path.F[0]).abs().max() > 1e-3  # it does deform
    linear = [linear_momentum(mass, path.v[n]) for n in (0, -1)]
    torch.testing.assert_close(linear[1], linear[0], rtol=1e-11, atol=0)
    spin = [
        angular_momentum(WEIGHTLESS, mass, path.x[n] - x0.mean(dim=0), path.v[n], path.C[n]) for n in (0, -1)
    ]
    torque = -sum((vol0[:, None] * axial(law.elasticity(F))).sum(dim=0) for F in path.F[:-1])
    torch.testing.assert_close(spin[1] - spin[0], DT * torque, rtol=0, atol=1e-11 * float(spin[0].norm()))
    if name == "neural":
        assert DT * torque.norm() > 1e-6 * spin[0].norm()  # there is something to see


def test_a_rigid_motion_has_the_momenta_of_its_velocity_and_spin():
    """Linear momentum m v, angular momentum I w about the centre of mass, for unequal masses."""
    x, _, vol0 = cube(side=0.25)
    mass = 1e3 * vol0 * (1 + 3 * (x[:, 0] > x[:, 0].mean()))
    velocity, spin = torch.tensor([[0.3, -1.0, 0.2], [2.0, -3.0, 4.0]], dtype=x.dtype)
    state = State.rigid(x, mass, vol0, velocity, spin)
    torch.testing.assert_close(linear_momentum(mass, state.v), mass.sum() * velocity)
    arm = x - mass @ x / mass.sum()
    inertia = (mass * arm.square().sum(1)).sum() * torch.eye(3).double() - (mass[:, None] * arm).mT @ arm
    actual = (mass[:, None] * torch.linalg.cross(arm, state.v)).sum(0)
    torch.testing.assert_close(actual, inertia @ spin)
    # C is the gradient of v: it takes v from one particle to another.
    torch.testing.assert_close(state.v[7] + state.C[7] @ (x[3] - x[7]), state.v[3])
    about_a_corner = State.rigid(x, mass, vol0, velocity, spin, centre=x[0])
    torch.testing.assert_close(about_a_corner.v[0], velocity)


def test_free_rotation_of_a_stiff_cube():
    """x(t) = c(t) + R(w t) (x0 - c): a lattice keeps its axis, because its moments of inertia are equal.

    It stretches by rho w^2 r^2 / E or less (r: half the diagonal) and rings about that, and steps of dt follow the
    circle with an error of w dt / 2 at most; both relative to r.
    """
    dt, E, steps = 2e-4, 1e6, 500
    law = analytic_law({"elasticity": {"name": "fixed_corotated", "E": E, "nu": 0.3}}, dt)
    c, ticks = torch.tensor([0.5, 0.6, 0.5]).double(), 0.2 * ((torch.arange(7) + 0.5) / 7 - 0.5).double()
    x0 = c + torch.cartesian_prod(ticks, ticks, ticks)
    vol0 = torch.full((len(x0),), 0.2**3 / len(x0), dtype=x0.dtype)
    velocity, spin = torch.tensor([[0.2, 0.4, -0.1], [1.5, -2.0, 2.5]], dtype=x0.dtype)
    model, state = MPM(16, dt), State.rigid(x0, DENSITY * vol0, vol0, velocity, spin)
    assert not free_flight_steps(model, as_regions(law, len(x0)), state, steps)
    path = simulate(model, law, state, (steps,))
    assert contact_clearance(model, path.x, vol0) > 0
    t, gravity = steps * dt, torch.tensor(model.gravity)
    fallen = c + t * velocity + gravity * dt**2 * steps * (steps + 1) / 2
    R = torch.linalg.matrix_exp(t * cross_matrix(spin))
    r, w = float((x0 - c).norm(dim=1).max()), float(spin.norm())
    stretch = DENSITY * w**2 * r**2 / E
    error = (path.x[0] - fallen - (x0 - c) @ R.mT).norm(dim=1).max()
    assert error < r * (2 * stretch + w * dt / 2)
    assert (path.F[0] - R).norm(dim=(1, 2)).max() < 3 * (2 * stretch + w * dt / 2)
    assert w * t * r > 100 * error  # it did turn


@pytest.mark.parametrize("contact, condition", BOUNDARIES)
@pytest.mark.parametrize("wall", WALLS)
def test_impact_on_a_wall(wall, contact, condition):
    """The body stays inside and turns; its motion along the wall lasts if the wall is slippery.

    It arrives after 0.018 s and rebounds when a wave has crossed it twice, 2 side / c = 0.049 s later. A wall
    that does not hold only takes momentum that points into it, and no wall gives energy.
    """
    axis, side = WALLS.index(wall) // 2, 1 if wall.endswith("max") else -1
    model = MPM(16, DT, gravity=(0.0, 0.0, 0.0), boundary=condition, contact=contact)
    centre = [0.5, 0.5, 0.5]
    centre[axis] = 0.69 if side > 0 else 0.25
    velocity = [0.2] * 3
    velocity[axis] = 3.0 * side
    start = moving_cube(velocity, centre=centre, side=0.2)
    v0, path = start.v, simulate(model, make_law("fixed_corotated"), start, range(121))
    low, high = model.stencil_range
    assert path.x.min() >= low and path.x.max() <= high
    assert contact_clearance(model, path.x, start.vol0).min() < 0  # it did arrive
    toward = side * path.v[..., axis].mean(dim=1)
    assert -v0.norm() <= toward[-1] < 0
    assert path.v[-1].square().mean() <= v0.square().mean()
    if condition != "sticky":
        assert (toward.diff() < 1e-12).all()
    mean = path.v[-1].mean(dim=0)
    along = [a for a in range(3) if a != axis]
    if condition == "slip":
        torch.testing.assert_close(mean[along], v0[along], rtol=1e-10, atol=0)
    else:
        assert (mean[along].abs() < v0[along]).all()


def test_walls_have_their_own_conditions():
    model = MPM(16, DT, boundary={"y_min": "slip", "x_max": "sticky"}, contact="nodes")
    assert model.boundary == ("no_slip", "sticky", "slip", "no_slip", "no_slip", "no_slip")
    assert hash(model) == hash(MPM(16, DT, boundary=model.boundary, contact="nodes"))
    faces = MPM(16, DT, boundary={"y_min": "slip"}).obstacles
    assert [face.friction for face in faces] == [math.inf, math.inf, 0.0, math.inf, math.inf, math.inf]


def test_free_flight_ends_where_contact_begins():
    """The simulated body leaves its parabola in the step that starts inside the contact zone, not before."""
    model = MPM(16, 2e-3)
    start, steps = moving_cube((0.0, -2.0, 0.0), centre=(0.5, 0.4, 0.5)), 60
    path = simulate(model, make_law("hencky"), start, range(steps + 1), skip_free_flight=False)
    first = int((contact_clearance(model, path.x, start.vol0) <= 0).int().argmax())
    assert 0 < first < steps
    strain = (path.F - torch.eye(3)).abs().amax(dim=(1, 2, 3))
    assert strain[: first + 1].max() < 1e-12 < strain[first + 1]


@pytest.mark.parametrize("name", ["fixed_corotated", "drucker_prager", "neural"])
def test_skipping_the_flight_changes_nothing(name):
    model, law = MPM(16, 2e-3), make_law(name)
    start = moving_cube((0.3, -2.0, 0.1), centre=(0.5, 0.35, 0.5))
    tracers, _, _ = cube(50, side=0.2, centre=(0.5, 0.35, 0.5), seed=1)
    both = [
        simulate(model, law, start, (0, 10, 40, 60), tracers=tracers, skip_free_flight=skip)
        for skip in (True, False)
    ]
    assert contact_clearance(model, both[0].x[-1], start.vol0) < 0
    for field in ("x", "v", "F", "C", "tracers"):
        a, b = (getattr(path, field) for path in both)
        torch.testing.assert_close(a, b, rtol=0, atol=1e-9)


def test_tracers_follow_the_body():
    """A tracer on a particle stays on it, one in empty space does not move, and none has an effect."""
    start = moving_cube((0.3, -2.0, 0.1), centre=(0.5, 0.3, 0.5))
    away = torch.tensor([[0.9, 0.9, 0.9]], dtype=start.x.dtype)
    args = MPM(16, 2e-3), make_law("hencky"), start, (0, 30, 60)
    plain = simulate(*args, skip_free_flight=False)
    path = simulate(*args, tracers=torch.cat([start.x[::7], away]), skip_free_flight=False)
    assert torch.equal(path.x, plain.x)
    torch.testing.assert_close(path.tracers[:, :-1], path.x[:, ::7], rtol=0, atol=1e-12)
    assert torch.equal(path.tracers[:, -1], away.expand(3, 3))


def test_distant_bodies_do_not_interact():
    """Two bodies with two laws on one grid move as each would alone."""
    model, frames = MPM(20, DT), (20, 60)
    starts = [
        moving_cube((0.0, -2.0, 0.0), count=200, side=0.2, centre=centre, seed=i)
        for i, centre in enumerate([(0.3, 0.2, 0.3), (0.7, 0.2, 0.7)])
    ]
    laws = [make_law("fixed_corotated"), make_law("drucker_prager")]
    alone = [simulate(model, law, start, frames) for law, start in zip(laws, starts, strict=True)]
    both = simulate(model, consecutive(laws, [200, 200]), State.joined(starts), frames)
    for field in ("x", "v", "F", "C"):
        separate = torch.cat([getattr(path, field) for path in alone], dim=1)
        torch.testing.assert_close(getattr(both, field), separate, rtol=0, atol=1e-12)


def test_bodies_collide():
    """Momentum passes from one body to the other, and none is lost.

    Both have mass m, and 80 steps are longer than a wave takes to cross one twice, 2 side / c = 0.049 s. When they part
    again the body that was hit is faster than their common centre, 1 m/s, and not faster than the other was, 2 m/s.
    """
    left, right = (
        moving_cube((speed, 0.0, 0.0), count=200, side=0.2, centre=(x, 0.5, 0.5))
        for speed, x in ((2.0, 0.36), (0.0, 0.64))
    )
    bodies = consecutive([make_law("hencky"), make_law("neo_hookean")], [200, 200])
    state = State.joined([left, right])
    path = simulate(WEIGHTLESS, bodies, state, (0, 80))
    assert 1.0 < path.v[-1, 200:, 0].mean() < 2.0
    before, after = (linear_momentum(state.mass, path.v[n]) for n in (0, -1))
    torch.testing.assert_close(after, before, rtol=0, atol=1e-12)


def test_same_start_same_bytes():
    """Also when other sizes and models used the buffers in between."""
    x0, mass, vol0 = cube(centre=(0.5, 0.25, 0.5), dtype=torch.float32)
    v0 = torch.tensor([0.3, -2.0, 0.1])
    law = make_law("neural", torch.float32)

    def run(count, **options):
        x = x0[:count].clone().requires_grad_()
        state = State(x, v0, mass[:count], vol0[:count])
        path = simulate(MPM(16, DT), law, state, (5, 50), **options)
        (path.x**2).sum().backward()
        return path.x.detach(), path.F.detach(), x.grad

    first = run(300)
    run(200)
    run(300, cache_bytes=0)
    for a, b in zip(first, run(300), strict=True):
        assert torch.equal(a, b)


def test_courant_number_names_the_largest_step():
    model = MPM(24, 5e-3)
    law = make_law("hencky")
    with refused("dt") as error:
        model.check_courant(law, DENSITY)
    stable = float(error.value.remedy.split("dt <= ")[-1].split()[0])
    assert MPM(24, 0.99 * stable).check_courant(law, DENSITY) == pytest.approx(0.792, rel=0.01)
    with pytest.raises(InputError):
        MPM(24, 1.01 * stable).check_courant(law, DENSITY)


@pytest.mark.parametrize(
    "settings, where",
    [
        (dict(boundary="glue"), "boundary"),
        (dict(boundary={"floor": "slip"}), "boundary"),
        (dict(boundary=("slip", "slip")), "boundary"),
        (dict(grid=4), "grid"),
        (dict(dt=-1.0), "dt"),
        (dict(dt=float("nan")), "dt"),
        (dict(gravity=(0.0, -9.8)), "gravity"),
        (dict(contact="padded"), "contact"),
        (dict(contact="released", wall_cells=0), "wall_cells"),
        (dict(wall_cells=2), "wall_cells"),
    ],
)
def test_wrong_model_is_named(settings, where):
    with refused(where):
        MPM(**{"grid": 16, "dt": DT, **settings})


@pytest.mark.parametrize(
    "change, where",
    [
        (dict(x=lambda x: x + 0.5), "state.x"),
        (dict(x=lambda x: x * float("nan")), "state.x"),
        (dict(x=lambda x: x[:, :2]), "state.x"),
        (dict(v=lambda x: x[:5]), "state.v"),
        (dict(v=lambda x: x.float()), "state.v"),
        (dict(v=lambda x: x / 0), "state.v"),
        (dict(F=lambda x: x), "state.F"),
        (dict(mass=lambda x: -x[:, 0]), "state.mass"),
        (dict(vol0=lambda x: x), "state.vol0"),
        (dict(frames=lambda x: (3, 2)), "frames"),
        (dict(frames=lambda x: (0, 21)), "frames"),
        (dict(tracers=lambda x: x[:, :2]), "tracers"),
        (dict(law=lambda x: [MaterialRegion(make_law("hencky"), 0, 299)]), "regions"),
        (dict(law=lambda x: [MaterialRegion(make_law("hencky"), n, 300 - n) for n in (0, 1)]), "region"),
    ],
)
def test_wrong_start_is_named(change, where):
    x0, mass, vol0 = cube()
    state = dict(x=x0, v=torch.zeros_like(x0), mass=mass, vol0=vol0)
    rest = dict(law=make_law("hencky"), steps=20, frames=(20,))
    for key, make in change.items():
        (state if key in (*state, "F") else rest)[key] = make(x0)
    with refused(where):
        rollout(MPM(16, DT), state=State(**state), **rest)


class BreaksAt(Plasticity):
    """Gives NaN for one particle from one step on."""

    def __init__(self, step, particle):
        super().__init__()
        self.calls, self.step, self.particle = 0, step, particle

    def response(self, F, weights):
        F = F.clone()
        self.calls += 1
        if self.calls >= self.step:
            F[self.particle] = torch.nan
        return F


@pytest.mark.parametrize("last", [20, 7], ids=["on the way", "in the last step"])
def test_nan_names_step_and_particle(last):
    start = moving_cube((0.0, 0.0, 0.0))
    law, x0 = Law(make_law("hencky").elasticity, BreaksAt(7, 123), "brittle"), start.x
    with pytest.raises(NonFiniteError, match="brittle") as error:
        rollout(MPM(16, DT), law, start, steps=20, frames=(last,), skip_free_flight=False)
    # F becomes NaN in step 7; its stress reaches the velocities, of neighbours too, one step later.
    assert error.value.step == (7 if last == 7 else 8)
    assert "dt" in str(error.value)
    near = (x0[error.value.particle] - x0[123]).abs().max()
    assert near < 3 / 16 and (last > 7 or error.value.particle == 123)


def test_instability_is_an_error():
    """Far above the Courant limit the simulation ends with an error. Positions never index outside the grid."""
    start = moving_cube((0.0, -3.0, 0.0), centre=(0.5, 0.25, 0.5))
    with pytest.raises(NonFiniteError, match="smaller dt"):
        simulate(MPM(16, 4e-2), make_law("neo_hookean"), start, (200,))


def test_hold_last_repeats_the_last_frame():
    path = simulate(MPM(16, DT), make_law("hencky"), moving_cube((0.0, 0.0, 0.0)), (0, 5))
    held = path.hold_last(3)
    assert held.frames == (0, 5, 5, 5, 5) and held.tracers is None
    assert torch.equal(held.x[1:], path.x[1:].expand(4, -1, -1))
