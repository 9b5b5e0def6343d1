"""Prescribed motions: key frames against interpolated rotations and finite differences, and a body that they press."""

import math

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation, Slerp

from neuma_lib.mechanics.analytic import analytic_law
from neuma_lib.sim.colliders import Collider
from neuma_lib.sim.free_flight import free_flight_steps
from neuma_lib.sim.model import MPM, as_regions, contact_clearance
from neuma_lib.sim.motion import rotation_vector, turned
from neuma_lib.sim.rollout import rollout
from neuma_lib.sim.state import State
from tests.support.errors import refused
from tests.support.sim_scenes import DENSITY, make_law, moving_cube

pytestmark = pytest.mark.core

KEYFRAMES = (
    (0.1, (0.5, 0.2, 0.5), (0.3, 0.1, 0.0)),
    (0.25, (0.6, 0.3, 0.4), (-0.5, 1.2, 0.8)),
    (0.3, (0.6, 0.3, 0.4), (2.0, 1.5, -1.0)),
)
REST = (0.0, 0.0, 0.0)


def test_a_pose_between_key_frames_is_interpolated():
    """Linear in the centre, spherical in the rotation, constant outside; as `scipy.spatial.transform.Slerp`."""
    collider = Collider("box", (0.1, 0.2, 0.3), keyframes=KEYFRAMES)
    times, centres, rotations = zip(*KEYFRAMES, strict=True)
    slerp = Slerp(times, Rotation.from_rotvec(rotations))
    for time in (-0.2, 0.0, 0.1, 0.17, 0.25, 0.28, 0.3, 0.7):
        inside = min(max(time, times[0]), times[-1])
        axes, centre = collider.pose(time)
        np.testing.assert_allclose(axes, slerp(inside).as_matrix(), atol=1e-12)
        expected = [np.interp(time, times, [c[a] for c in centres]) for a in range(3)]
        np.testing.assert_allclose(centre, expected, atol=1e-15)


@pytest.mark.parametrize("motion", [{"keyframes": KEYFRAMES}, {"velocity": (1, 2, 3), "spin": (0, 4, 5)}, {}])
def test_a_later_motion_continues(motion):
    collider = Collider("sphere", (0.1,), **motion)
    later = collider.later(0.2)
    for time in (0.0, 0.07, 0.3):
        for own, expected in zip(later.pose(time), collider.pose(0.2 + time), strict=True):
            torch.testing.assert_close(own, expected, rtol=0, atol=1e-12)


@pytest.mark.parametrize("motion", [{"keyframes": KEYFRAMES}, {"velocity": (1, 2, 3), "spin": (0, 4, 5)}])
def test_an_object_at_rest_stays_in_its_first_pose(motion):
    collider = Collider("sphere", (0.1,), **motion)
    still = collider.at_rest()
    assert not still.moves and still.velocity == still.spin == REST and still.keyframes == ()
    for time in (0.0, 0.5):
        for own, expected in zip(still.pose(time), collider.pose(0.0), strict=True):
            torch.testing.assert_close(own, expected, rtol=0, atol=1e-12)
    assert still.at_rest() is still


@pytest.mark.parametrize("time", [0.05, 0.17, 0.28, 0.4])
def test_the_velocity_is_the_change_of_the_pose(time):
    """A point that is fixed in the frame moves with `velocity_at`; `fastest` is an upper bound in the cube."""
    collider = Collider("sphere", (0.1,), keyframes=KEYFRAMES)
    local = torch.tensor([0.1, -0.2, 0.3], dtype=torch.float64)
    (a, b), (c, d) = collider.pose(time - 1e-6), collider.pose(time + 1e-6)
    moved = (d + c @ local - b - a @ local) / 2e-6
    velocity = collider.velocity_at(0.5 * (d + c @ local + b + a @ local), time)
    torch.testing.assert_close(velocity, moved, rtol=1e-8, atol=1e-8)
    corners = torch.cartesian_prod(*[torch.tensor([0.0, 1.0], dtype=torch.float64)] * 3)
    assert collider.velocity_at(corners, time).norm(dim=1).max() <= collider.fastest(time)


def test_a_rotation_vector_is_the_inverse_of_the_exponential():
    """For small angles, generic ones and half turns, whose sign is arbitrary."""
    generator = torch.Generator().manual_seed(0)
    axes = torch.nn.functional.normalize(torch.randn(20, 3, generator=generator, dtype=torch.float64), dim=1)
    for angle in (0.0, 1e-9, 0.3, 3.0, math.pi - 1e-7, math.pi):
        for axis in axes:
            turn = turned(angle * axis)
            again = rotation_vector(turn)
            assert float(again.norm()) <= math.pi + 1e-12
            torch.testing.assert_close(turned(again), turn, rtol=0, atol=1e-9)


def test_two_key_frames_are_a_constant_velocity_and_spin():
    """States after contact with a turning box are the same for both ways to state its motion."""
    velocity, spin, end = (0.2, 0.5, -0.3), (1.0, -2.0, 3.0), 0.1
    centre = (0.45, 0.3, 0.5)
    plain = Collider("box", (0.15, 0.1, 0.2), centre, velocity=velocity, spin=spin, friction=0.4)
    last = tuple(c + end * v for c, v in zip(centre, velocity, strict=True))
    frames = ((0.0, centre, REST), (end, last, tuple(end * w for w in spin)))
    keyed = Collider("box", (0.15, 0.1, 0.2), keyframes=frames, friction=0.4)
    start = moving_cube((0.0, -1.0, 0.0), centre=(0.5, 0.56, 0.5), side=0.2)
    law = make_law("hencky")
    models = [MPM(16, 1e-3, contact="particles", colliders=(collider,)) for collider in (plain, keyed)]
    a, b = (rollout(model, law, start, steps=100, frames=(60, 100)) for model in models)
    assert (a.F - torch.eye(3)).abs().max() > 0.01
    torch.testing.assert_close(a.x, b.x, rtol=0, atol=1e-10)


def test_free_flight_ends_where_a_moving_collider_touches():
    """A sphere that waits and then rises meets the falling body; the flight before it is in closed form."""
    frames = ((0.05, (0.5, 0.15, 0.5), REST), (0.15, (0.5, 0.3, 0.5), REST))
    collider = Collider("sphere", (0.1,), keyframes=frames)
    model, law = MPM(16, 1e-3, contact="particles", colliders=(collider,)), make_law("hencky")
    start = moving_cube((0.0, -1.0, 0.0), centre=(0.5, 0.65, 0.5), side=0.2)
    free = free_flight_steps(model, as_regions(law, len(start.x)), start, 200)
    path = rollout(model, law, start, steps=200, frames=range(201), skip_free_flight=False)
    clear = contact_clearance(model, path.x, start.vol0, range(201))
    assert 50 < free < 150 and clear[free - 1] > 0 >= clear[free] - 2e-3 * model.dx
    skipped = rollout(model, law, start, steps=200, frames=(100, 200))
    torch.testing.assert_close(skipped.x, path.x[[100, 200]], rtol=0, atol=1e-9)


def test_a_press_compresses_a_block_and_stops():
    """A slab lowers by 3 % of the height L of a block and rests: at mid-height the strain is that of a column.

    Contact acts on the outermost particles, so on the grid the stress rises from zero to its full value within the
    kernel's radius of 1.5 cells from either slab. The mean strain of these layers is between half of and the full one,
    so the strain at mid-height is between 3 % and 3 % L / (L - 1.5 dx). Penetration, the pressure 0.03 E over the
    stiffness alpha rho d / dt^2 of a layer of particles with spacing d, is 0.03 mm, 0.5 % of the displacement.
    """
    side, dt = 0.2, 5e-4
    slab = {"shape": "box", "size": (0.3, 0.05, 0.3), "friction": 0.0, "damping": 1.0}
    top = 0.2 + side + 0.05
    frames = ((0.0, (0.5, top, 0.5), REST), (0.3, (0.5, top - 0.03 * side, 0.5), REST))
    colliders = (Collider(centre=(0.5, 0.15, 0.5), **slab), Collider(keyframes=frames, **slab))
    model = MPM(32, dt, gravity=(0.0, 0.0, 0.0), contact="particles", colliders=colliders)
    ticks = side * ((torch.arange(8) + 0.5) / 8 - 0.5).double()
    x = torch.cartesian_prod(ticks, ticks, ticks) + torch.tensor([0.5, 0.3, 0.5], dtype=torch.float64)
    vol0 = torch.full((len(x),), side**3 / len(x), dtype=torch.float64)
    law = analytic_law({"elasticity": {"name": "neo_hookean", "E": 5e4, "nu": 0.0}}, dt)
    state = State(x, torch.zeros(3).double(), DENSITY * vol0, vol0)
    path = rollout(model, law, state, steps=1200, frames=(600, 1000, 1200))
    middle = (x[:, 1] - 0.3).abs() < 0.06
    strains = path.F[:, middle, 1, 1].mean(dim=1) - 1
    assert (-strains > 0.03).all() and (-strains < 0.03 * side / (side - 1.5 * model.dx)).all()
    assert path.v[1:].abs().max() < 0.02 * 0.2


@pytest.mark.parametrize(
    "settings",
    [
        dict(keyframes=KEYFRAMES[::-1]),
        dict(keyframes=(KEYFRAMES[0], KEYFRAMES[0])),
        dict(keyframes=((0.0, (0.0, 0.0), REST),)),
        dict(keyframes=((0.0, (0.0, math.inf, 0.0), REST),)),
        dict(keyframes=((math.nan, REST, REST),)),
        dict(keyframes=((0.0, REST),)),
        dict(keyframes=KEYFRAMES, velocity=(0.0, 1.0, 0.0)),
        dict(keyframes=KEYFRAMES, centre=(0.5, 0.5, 0.5)),
    ],
)
def test_wrong_key_frames_are_refused(settings):
    with refused("collider.keyframes"):
        Collider("sphere", (0.1,), **settings)
