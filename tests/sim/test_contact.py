"""Contact of particles with colliders: against the torch twin, finite differences and closed forms."""

import math
from dataclasses import replace

import pytest
import torch

from benchmarks import torch_simulation
from neuma_lib.mechanics.analytic import analytic_law
from neuma_lib.sim.colliders import SIZES, Collider, contact_radius
from neuma_lib.sim.free_flight import free_flight_steps
from neuma_lib.sim.model import MPM, as_regions, contact_clearance
from neuma_lib.sim.rollout import rollout
from neuma_lib.sim.state import State
from tests.support.contact_scenes import (
    COLLIDERS,
    MOTION,
    SHAPES,
    assert_equals_twin,
    assert_gradient_is_the_difference,
    falling_on,
    lattice,
)
from tests.support.errors import refused
from tests.support.sim_scenes import DENSITY, DT, angular_momentum, linear_momentum, make_law, moving_cube

pytestmark = pytest.mark.core

GRAVITY = 9.8


@pytest.mark.parametrize("name", COLLIDERS)
def test_equals_the_torch_twin(name):
    assert_equals_twin(*falling_on(COLLIDERS[name], SHAPES["plane"]))


@pytest.mark.parametrize("name", COLLIDERS)
def test_finite_differences(name):
    assert_gradient_is_the_difference(*falling_on(COLLIDERS[name], SHAPES["plane"]))


@pytest.mark.parametrize("name", SHAPES)
def test_distances_are_those_of_the_nearest_point_of_the_surface(name):
    """Moving a point outside by its distance against the normal leads to the surface; the normal is the gradient."""
    collider = SHAPES[name]
    x = torch.rand(500, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64).requires_grad_()
    distance, normal = collider.surface(x)
    torch.testing.assert_close(normal.norm(dim=1), torch.ones(500, dtype=torch.float64))
    (gradient,) = torch.autograd.grad(distance.sum(), x)
    torch.testing.assert_close(gradient, normal)
    outside = distance > 0
    on_surface, _ = collider.surface((x - distance[:, None] * normal)[outside])
    assert outside.sum() > 50 and on_surface.abs().max() < 1e-12


@pytest.mark.parametrize("normal", [(0.0, 2.0, 0.0), (0.0, -0.5, 0.0), (3.0, 0.0, 0.0), (-0.2, 0.7, 1.9)])
def test_a_plane_has_the_distance_from_its_point_along_its_normal(normal):
    """However long the normal is."""
    n = torch.tensor(normal, dtype=torch.float64)
    n, point = n / n.norm(), torch.tensor([0.2, 0.5, 0.4], dtype=torch.float64)
    x = torch.rand(20, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    distance, normals = Collider.plane(point.tolist(), normal, friction=0.3).surface(x)
    torch.testing.assert_close(distance, (x - point) @ n, rtol=0, atol=1e-12)
    torch.testing.assert_close(normals, n.expand(20, 3), rtol=0, atol=1e-12)


def test_a_pose_follows_velocity_and_spin():
    """The velocity of a point that is fixed in the collider is the change of its place."""
    collider = replace(SHAPES["box"], **MOTION)
    local = torch.tensor([0.1, -0.2, 0.3], dtype=torch.float64)
    places = []
    for time in (0.3 - 1e-6, 0.3 + 1e-6):
        axes, centre = collider.pose(time)
        places.append(centre + axes @ local)
    moved = (places[1] - places[0]) / 2e-6
    torch.testing.assert_close(
        moved, collider.velocity_at(0.5 * (places[0] + places[1]), 0.3), rtol=1e-8, atol=1e-8
    )


def test_no_particle_in_contact_moves_as_without_contact():
    """Before the first contact the states have the bytes of a model without colliders."""
    start = moving_cube((0.3, 0.0, 0.1), centre=(0.5, 0.7, 0.5))
    with_colliders = MPM(16, DT, contact="particles", colliders=tuple(SHAPES.values())[2:3])
    plain = MPM(16, DT, contact="nodes")
    law = make_law("hencky")
    paths = [
        rollout(model, law, start, steps=20, frames=(20,), skip_free_flight=False)
        for model in (with_colliders, plain)
    ]
    assert torch.equal(paths[0].x, paths[1].x)


@pytest.mark.parametrize("moving", [False, True])
def test_free_flight_ends_where_the_body_touches(moving):
    """The simulated body leaves its parabola in the step in which the first particle touches the sphere."""
    collider = Collider("sphere", (0.1,), (0.5, 0.15, 0.5), velocity=(0.0, 0.5 * moving, 0.0))
    model, law = MPM(16, 1e-3, contact="particles", colliders=(collider,)), make_law("hencky")
    start = moving_cube((0.0, -2.0, 0.0), centre=(0.5, 0.6, 0.5), side=0.2)
    free = free_flight_steps(model, as_regions(law, len(start.x)), start, 100)
    path = rollout(model, law, start, steps=100, frames=range(101), skip_free_flight=False)
    clear = contact_clearance(model, path.x, start.vol0, range(101))
    assert 20 < free < 100 and clear[free - 1] > 0 >= clear[free] - 2e-3 * model.dx
    strain = (path.F - torch.eye(3)).abs().amax(dim=(1, 2, 3))
    assert strain[:free].max() < 1e-12 < strain[free + 2 :].max()
    skipped = rollout(model, law, start, steps=100, frames=(50, 100))
    torch.testing.assert_close(skipped.x, path.x[[50, 100]], rtol=0, atol=1e-9)


@pytest.mark.parametrize("friction, angle", [(0.3, 30.0), (0.0, 30.0), (0.8, 30.0), (0.3, 10.0)])
def test_a_block_on_an_inclined_plane(friction, angle):
    """It slides with g (sin a - mu cos a), and stays if mu > tan a.

    Gravity is inclined instead of the plane. The block starts at rest on the plane and rings for some milliseconds,
    which changes the normal force but not its mean. It is stiff, so that it shears little.
    """
    a = math.radians(angle)
    side, dt = 0.2, 2e-4
    gravity = (GRAVITY * math.sin(a), -GRAVITY * math.cos(a), 0.0)
    floor = Collider.plane((0.0, 0.2, 0.0), (0.0, 1.0, 0.0), friction=friction, damping=0.5)
    model = MPM(16, dt, gravity=gravity, contact="particles", colliders=(floor,))
    x, mass, vol0 = lattice(side, 8, (0.3, 0.3, 0.5))
    law = analytic_law({"elasticity": {"name": "neo_hookean", "E": 2e5, "nu": 0.3}}, dt)
    steps = (500, 1500)
    path = rollout(model, law, State(x, torch.zeros(3).double(), mass, vol0), steps=steps[-1], frames=steps)
    speed = path.v[:, :, 0].mean(dim=1)
    measured = float(speed[1] - speed[0]) / (dt * (steps[1] - steps[0]))
    expected = GRAVITY * max(0.0, math.sin(a) - friction * math.cos(a))
    assert abs(measured - expected) < 0.03 * GRAVITY
    if expected == 0:
        assert abs(float(path.x[1, :, 0].mean() - path.x[0, :, 0].mean())) < 1e-3


@pytest.mark.parametrize("friction", [0.0, 0.4, math.inf])
def test_momenta_change_by_the_impulse_on_the_collider(friction):
    """Linear and angular momentum of a step, gravity and contact, to round-off.

    The transfer conserves both, except for the moment of the stress of the affine velocities, which is symmetric here.
    The torch twin has the displacements that friction depends on.
    """
    model, start = falling_on(replace(COLLIDERS["moving"], friction=friction), SHAPES["plane"])
    model = replace(model, colliders=model.colliders[:1])
    law = make_law("fixed_corotated")
    path = rollout(model, law, start, steps=41, frames=(40, 41))
    before = State(path.x[0], path.v[0], start.mass, start.vol0, path.F[0], path.C[0])
    twin = (*start.motion, torch.zeros_like(start.x))
    for n in range(40):
        twin = torch_simulation.step(model, as_regions(law, 60), *twin, start.mass, start.vol0, n * DT)
    torch.testing.assert_close(twin[0], before.x, rtol=0, atol=1e-12)
    v, _ = torch_simulation.contact(model, before.x, before.v, twin[-1], before.vol0, 40 * DT)
    impulse = start.mass[:, None] * (v - before.v)
    assert impulse.norm() > 1e-3 * linear_momentum(start.mass, before.v).norm()
    weight = start.mass.sum() * DT * torch.tensor(model.gravity, dtype=torch.float64)
    gained = linear_momentum(start.mass, path.v[1]) - linear_momentum(start.mass, path.v[0])
    torch.testing.assert_close(gained, impulse.sum(dim=0) + weight, rtol=0, atol=1e-12)
    spins = [angular_momentum(model, start.mass, path.x[n], path.v[n], path.C[n]) for n in (0, 1)]
    moment = torch.linalg.cross(before.x, impulse).sum(dim=0)
    lever = torch.linalg.cross(
        linear_momentum(start.mass, path.x[0]), model.dt * torch.tensor(model.gravity).double()
    )
    # positions move with the new velocities within the step: x_1 x v_1 = x_0 x v_1
    torch.testing.assert_close(spins[1] - spins[0], moment + lever, rtol=0, atol=1e-9)


def test_a_slab_that_moves_up_lifts_a_resting_body():
    """At constant speed the body follows the slab; it does not sink in by more than 0.25 dx."""
    slab = Collider("box", (0.3, 0.02, 0.3), (0.5, 0.1, 0.5), velocity=(0.0, 0.4, 0.0), damping=0.5)
    model = MPM(16, 5e-4, contact="particles", colliders=(slab,))
    x, mass, vol0 = lattice(0.2, 8, (0.5, 0.222, 0.5))
    law = analytic_law({"elasticity": {"name": "neo_hookean", "E": 1e5, "nu": 0.3}}, 5e-4)
    path = rollout(model, law, State(x, torch.zeros(3).double(), mass, vol0), steps=1000, frames=(500, 1000))
    risen = float((path.x[1] - path.x[0])[:, 1].mean())
    assert abs(risen - 0.4 * 0.25) < 0.01
    top = 0.12 + 0.4 * 0.5
    assert (path.x[1, :, 1] - float(contact_radius(vol0)[0]) - top).min() > -0.25 * model.dx


def test_a_column_at_rest_carries_its_weight():
    """The pressure is rho g h within 3 %, averaged over the layers between 1.5 cells and half the height.

    Nearer to its surfaces a body on a grid has a layer of 1.5 cells in which stress and force are smeared.
    """
    dt, count, side = 1e-4, 16, 0.2
    floor = Collider.plane((0.0, 0.1, 0.0), (0.0, 1.0, 0.0), friction=0.0, damping=1.0)
    model = MPM(40, dt, contact="particles", colliders=(floor,))
    x, mass, vol0 = (value.float() for value in lattice(side, count, (0.5, 0.1 + side / 2, 0.5)))
    law = analytic_law({"elasticity": {"name": "neo_hookean", "E": 1e5, "nu": 0.3}}, dt)
    state = State(x, torch.zeros(3), mass, vol0)
    for _ in range(4):  # stopped again and again, it comes to rest
        path = rollout(model, law, state, steps=200, frames=range(20, 201, 20), skip_free_flight=False)
        state = State(path.x[-1], torch.zeros(3), mass, vol0, path.F[-1])
    height = x[:, 1] - 0.1
    inner = (height > 1.5 * model.dx) & (height < side / 2)
    pressure = -torch.stack([law.elasticity(F[inner])[:, 1, 1].mean() for F in path.F]).mean()
    expected = DENSITY * GRAVITY * (side - height[inner]).mean()
    assert float(pressure) == pytest.approx(float(expected), rel=0.03)


@pytest.mark.parametrize(
    "settings, where",
    [
        (dict(shape="cone"), "collider.shape"),
        (dict(shape="sphere"), "collider.size"),
        (dict(shape="sphere", size=(-0.1,)), "collider.size"),
        (dict(shape="box", size=(0.1, 0.1)), "collider.size"),
        (dict(shape="sphere", size=(0.1,), centre=(0.0, math.nan, 0.0)), "collider.centre"),
        (dict(shape="sphere", size=(0.1,), friction=-1.0), "collider.friction"),
        (dict(shape="sphere", size=(0.1,), friction=math.nan), "collider.friction"),
        (dict(shape="sphere", size=(0.1,), damping=2.0), "collider.damping"),
    ],
)
def test_wrong_colliders_are_refused(settings, where):
    with refused(where):
        Collider(**settings)


def test_walls_and_colliders_have_coefficients_of_their_own_or_one_in_common():
    model = MPM(16, DT, contact="particles", boundary={"y_min": 0.3, "x_max": "slip", "z_min": math.inf})
    model = replace(model, colliders=(SHAPES["box"], COLLIDERS["sticking"]))
    own = [math.inf, 0.0, 0.3, math.inf, math.inf, math.inf, 0.4, math.inf]
    assert [obstacle.friction for obstacle in model.obstacles] == own
    assert {obstacle.friction for obstacle in model.with_friction(0.7).obstacles} == {0.7}
    others = model.with_friction(0.7, given=False)
    assert [each.friction for each in others.obstacles] == [0.7 if mu == math.inf else mu for mu in own]
    assert model.with_friction(math.inf) == model.with_friction(0.7).with_friction(math.inf)
    with refused("friction"):
        MPM(16, DT, contact="nodes").with_friction(0.3)


def test_wrong_models_are_refused():
    with refused("colliders"):
        MPM(16, DT, contact="nodes", colliders=(SHAPES["box"],))
    for boundary in ("sticky", -0.1, math.nan, True, None, {"y_min": "0.3"}):
        with refused("boundary"):
            MPM(16, DT, contact="particles", boundary=boundary)
    for contact in ("nodes", "released"):
        with refused("boundary"):
            MPM(16, DT, contact=contact, boundary={"y_min": 0.3})
    with refused("collider.normal"):
        Collider.plane((0.0, 0.0, 0.0), (0.0, 0.0, 0.0))
    assert set(SIZES) == {*SHAPES, "mesh"}  # test_mesh_colliders.py has that one
