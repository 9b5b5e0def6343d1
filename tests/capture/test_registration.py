"""Registration: pose, velocity, spin and offsets are those that were rendered, and undetermined ones are reported."""

import json
from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from neuma_lib.capture.registration.problem import FittedPose, Problem
from neuma_lib.capture.registration.registration import check_overlap, first_common, register
from neuma_lib.capture.registration.rigid_motion import RigidMotion, angle_between, rotate, spread_rotations
from neuma_lib.capture.registration.rigid_views import Body, Pictures
from neuma_lib.coupling.initial_motion import InitialMotion
from neuma_lib.splatting.gaussians import Gaussians
from neuma_lib.splatting.rasterizer import rasterize
from neuma_lib.splatting.rigid import moved
from tests.support.errors import refused
from tests.support.flight_scene import (
    GAINS,
    GRAVITY,
    ellipsoid_body,
    filmed,
    guess,
    photographed_in_light,
    true_motion,
)
from tests.support.render_scenes import random_scene

OFFSET = 0.0035


def registered(body, motion, spin=None, **options):
    """Registration, and its errors (12,) in turn [rad], place [m], velocity [m/s] and spin [rad/s]."""
    sights = filmed(body, motion, **options)
    result = register(body.gaussians, body.particles, body.mass, sights, guess(spin), "one")
    t = np.array([result.start - 3.0])
    (R,), (w,) = motion.turn(t)
    (c,), (v,) = motion.place(t)
    here = result.pose.motion
    turn = Rotation.from_matrix(here.rotation @ R.T).as_rotvec()
    return result, np.concatenate([turn, here.centre - c, here.velocity - v, here.spin - w])


def check_exact(result, errors, motion):
    speed = np.linalg.norm(result.pose.motion.velocity)
    assert np.degrees(np.linalg.norm(errors[:3])) < 1.5
    assert np.linalg.norm(errors[3:6]) < 0.003
    assert np.linalg.norm(errors[6:9]) < 0.03 * speed
    assert np.linalg.norm(errors[9:]) <= 0.1 * np.linalg.norm(motion.spin)


def check_gravity(result, true=GRAVITY):
    off = result.gravity - true
    assert np.linalg.norm(off) < 0.02 * 9.81
    assert (
        off @ np.linalg.pinv(result.gravity_covariance) @ off < 16.3
    )  # one in a thousand of chi-squared, 3 degrees


def test_pose_velocity_spin_offset_and_gains_are_those_that_were_rendered():
    body = ellipsoid_body(count=250)
    motion = true_motion(body, Rotation.random(random_state=1).as_matrix())
    result, errors = registered(body, motion, frames=8, offset=OFFSET, noise=0.02)
    check_exact(result, errors, motion)
    assert result.pose.offsets == pytest.approx([0.0, OFFSET], abs=1e-4)
    check_gravity(result)
    # Noise in the coverage is cut off at 1, which darkens edges.
    np.testing.assert_allclose(result.pose.gains, GAINS[:2], rtol=0.02)
    assert result.before.iou.mean() < 0.85 and result.after.iou.min() > 0.97 and result.after.off.max() < 0.2
    assert not result.ambiguous and result.rival[0] > 2 and result.spin_significant
    x = body.particles @ result.rotation.T + result.translation
    np.testing.assert_allclose(body.mass @ x / body.mass.sum(), result.pose.motion.centre, atol=1e-9)
    motion = InitialMotion.of(result.velocity())
    np.testing.assert_allclose(motion.velocity, result.pose.motion.velocity)
    assert (motion.std > 0).all() and (motion.axes == result.axes).all()
    report = json.loads(json.dumps(result.report(), allow_nan=False))
    assert set(report["offsets_s"]) == set(report["gains"]) == {"a", "b"} and report["ambiguous"] == ""
    assert {each.camera for each in result.comparisons} == {0, 1}
    assert all(each.seen.shape == each.rendered.shape for each in result.comparisons)


def test_a_body_half_hidden_by_another_is_placed_at_a_common_time():
    """The pixels of the other body, the left half in the first camera, are not background."""
    body = ellipsoid_body(count=250)
    motion = true_motion(body, Rotation.random(random_state=1).as_matrix())
    first, second = filmed(body, motion, frames=8, noise=0.02)
    images, hidden = first.images.copy(), np.zeros(first.images.shape[:3], bool)
    for image, other in zip(images, hidden, strict=True):
        other[:, : int(np.flatnonzero((image[..., 3] > 127).any(axis=0)).mean())] = True
        image[other] = 0
    sights = [replace(first, images=images, hidden=hidden), second]
    start = float(first.times[3])
    arguments = body.gaussians, body.particles, body.mass, sights, guess(), "one"
    result = register(*arguments, start=start)
    (R,), _ = motion.turn(np.array([start - 3.0]))
    (centre,), (velocity,) = motion.place(np.array([start - 3.0]))
    here = result.pose.motion
    assert result.start == start and result.after.iou.min() > 0.95
    assert np.degrees(angle_between(here.rotation, R)[0]) < 1.5
    assert np.linalg.norm(here.centre - centre) < 0.003
    assert np.linalg.norm(here.velocity - velocity) < 0.03 * np.linalg.norm(velocity)
    with refused("one", problem="ends 500 ms before that of another body begins", remedy="same time"):
        register(*arguments, start=float(min(sight.clock[-1] for sight in sights)) + 0.5)


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(2, 7))
def test_every_rotation_is_recovered(seed):
    body = ellipsoid_body()
    # The first is the pose of the photographs.
    turn = np.eye(3) if seed == 2 else Rotation.random(random_state=seed).as_matrix()
    motion = true_motion(body, turn)
    result, errors = registered(body, motion, offset=OFFSET, noise=0.02, views=2 + seed % 2)
    check_exact(result, errors, motion)
    assert not result.ambiguous


@pytest.mark.slow
@pytest.mark.parametrize("coloured", [True, False])
def test_lamps_that_stay_while_the_body_turns_do_not_mislead(coloured):
    body = ellipsoid_body(count=300, coloured=coloured, bump=0.5 if coloured else 0.9)
    motion = true_motion(body, Rotation.random(random_state=2).as_matrix())
    photographed = photographed_in_light(body)  # and with a bottom that nobody saw
    result, errors = registered(photographed, motion, offset=OFFSET, noise=0.02, light=True)
    check_exact(result, errors, motion)
    assert (np.abs(errors) < 4 * np.sqrt(np.diag(result.covariance)[:12])).all()


def test_one_camera_is_enough_and_less_sure_of_the_depth():
    body = ellipsoid_body(count=250)
    motion = true_motion(body, Rotation.random(random_state=3).as_matrix())
    result, errors = registered(body, motion, frames=8, views=1, noise=0.02)
    assert np.degrees(np.linalg.norm(errors[:3])) < 1.5
    depth = result.axes[2]
    across = errors[3:6] - depth * (depth @ errors[3:6])
    assert np.linalg.norm(across) < 0.002
    std = result.deviations(slice(3, 6), result.axes)
    assert abs(depth @ errors[3:6]) < 4 * std[2] and std[2] > 5 * std[:2].max()
    # Along its view gravity is taken as known.
    level = depth - depth @ GRAVITY / (GRAVITY @ GRAVITY) * GRAVITY
    assert abs(level @ result.gravity_covariance @ level) < 1e-9 and abs(level @ result.gravity) < 1e-9
    check_gravity(result)


def test_a_plain_ball_is_reported_as_ambiguous():
    body = ellipsoid_body(count=250, radii=(0.05, 0.05, 0.05), coloured=False, bump=0.0)
    motion = true_motion(body, np.eye(3))
    result, errors = registered(body, motion, frames=6, noise=0.02)
    assert "explains the video nearly as well" in result.ambiguous or "any axis" in result.ambiguous
    assert result.turn_deviations[-1] > 20
    assert np.linalg.norm(errors[3:6]) < 0.01 and np.linalg.norm(errors[6:9]) < 0.1


def test_frames_after_the_contact_are_left_out():
    """From the ninth frame on the body lies where it touched the floor, which silhouettes alone may take for flight."""
    body = ellipsoid_body(count=250)
    motion = true_motion(body, Rotation.random(random_state=8).as_matrix())
    (turn,), (centre,) = motion.turn(np.array([8.5 / 120]))[0], motion.place(np.array([8.5 / 120]))[0]
    floor = ((body.particles - body.pivot) @ turn.T + centre)[:, 1].min()
    sights = filmed(body, motion, frames=12, noise=0.02)
    for sight in sights:
        sight.images[9:] = sight.images[8]
    for height, bound in ((floor, 0.005), (None, np.inf)):
        result = register(body.gaussians, body.particles, body.mass, sights, guess(), "one", floor=height)
        off = np.linalg.norm(result.pose.motion.velocity - motion.place(np.array([result.start - 3.0]))[1][0])
        assert off < bound
    assert off > 0.05


def test_gravity_that_is_not_what_was_assumed_is_measured():
    """As a square size off by 15 percent shows it, or a floor that is not level."""
    body, velocity = ellipsoid_body(count=250), np.array([0.6, -8.4, 0.0])
    motion = replace(true_motion(body, Rotation.random(random_state=6).as_matrix()), gravity=velocity)
    result, _ = registered(body, motion, frames=12, offset=OFFSET, noise=0.02)
    check_gravity(result, velocity)


@pytest.mark.slow
def test_a_spin_that_is_not_distinguished_from_0_is_none():
    body = ellipsoid_body(count=250)
    motion = true_motion(body, Rotation.random(random_state=4).as_matrix(), spin=(0, 0, 0))
    result, errors = registered(body, motion, frames=6, noise=0.03)
    assert not result.spin_significant and not result.pose.motion.spin.any()
    check_exact(result, errors[:9], motion)
    assert (result.deviations(slice(9, 12)) > 0).all()


@pytest.mark.slow
def test_errors_are_as_large_as_the_deviations():
    body = ellipsoid_body(count=250)
    z = []
    for seed in range(8):
        motion = true_motion(body, Rotation.random(random_state=50 + seed).as_matrix())
        result, errors = registered(body, motion, offset=OFFSET, noise=0.05, seed=seed)
        z.append(errors / np.sqrt(np.diag(result.covariance)[:12]))
    # 8 x 12 of them, correlated within a flight: mean squares of chi-squared over 12 / 8 degrees of freedom or so
    assert 0.2 < np.square(z).mean() < 2.5
    assert (np.abs(z) > 3).mean() < 0.06


def test_another_object_is_refused():
    body = ellipsoid_body(count=250)
    other = ellipsoid_body(count=250, radii=(0.14, 0.02, 0.02), bump=0.0, seed=3)
    sights = filmed(other, true_motion(other, Rotation.random(random_state=5).as_matrix()), frames=3)
    with refused("one"):
        check_overlap(register(body.gaussians, body.particles, body.mass, sights, guess(), "one"), "one")


def test_flights_that_no_camera_shares_are_refused():
    body = ellipsoid_body(count=50)
    a, b = filmed(body, true_motion(body, np.eye(3)), frames=4)
    with refused("one"):
        register(body.gaussians, body.particles, body.mass, [a, replace(b, offset=5.0)], guess(), "one")
    assert first_common([a, replace(b, times=b.times + 0.012)], "one") == pytest.approx(3 + 2 / 120)
    behind = replace(guess(), place=np.array([0.5, 0.7, 3.0]))
    with refused("one"):
        register(body.gaussians, body.particles, body.mass, [a, b], behind, "one")
    with refused("a"):
        replace(a, images=np.zeros_like(a.images)).boxes()


def test_slopes_are_those_of_the_cost():
    body = ellipsoid_body(count=120)
    motion = true_motion(body, Rotation.random(random_state=7).as_matrix())
    sights = filmed(body, motion, frames=3, offset=OFFSET)
    about = Body.about(body.gaussians, body.pivot)
    pictures = Pictures(about, sights, 64, [1.0, 1.0])
    off = replace(
        motion,
        rotation=Rotation.from_rotvec([0.05, -0.04, 0.06]).as_matrix() @ motion.rotation,
        centre=motion.centre + (0.002, -0.003, 0.002),
    )
    begin = FittedPose(off, np.array([0.0, 0.002]), 0.01, GAINS[:2])
    problem = Problem(pictures, begin, 3.0, [1], falling=np.eye(3), central=True)
    fit = problem.linearise(problem.start, problem.all)
    # steps of about a third of a pixel, over which the cost bends
    steps = np.array([0.002] * 3 + [0.01] * 3 + [0.05] * 3 + [0.05] * 3 + [0.5] + [1.0] * 3 + [0.1])
    for k in problem.all:
        e = steps[k] * np.eye(problem.size)[k]
        slope = (problem.cost(problem.start + e) - problem.cost(problem.start - e)) / (4 * steps[k])
        scale = np.sqrt(fit.curvature[k, k] * fit.cost)
        assert abs(fit.slope[k] - slope) < 0.03 * scale, k
    assert fit.cost == pytest.approx(problem.cost(problem.start), rel=1e-5)


def test_a_free_body_keeps_its_angular_momentum():
    inertia = np.diag([1.0, 1.4, 1.9])
    R = Rotation.random(random_state=1).as_matrix()
    motion = RigidMotion(R, np.zeros(3), np.zeros(3), np.array([4.0, -3.0, 5.0]), np.zeros(3), inertia)
    times = np.linspace(-0.2, 0.4, 13)
    turns, spins = motion.turn(times)
    momentum = np.einsum("tij,jk,tlk,tl->ti", turns, inertia, turns, spins)
    # Fourth order in steps of 0.1 rad: 0.1^4 / 120 a radian, of which there are 3, times the ratio of the moments
    np.testing.assert_allclose(momentum, np.broadcast_to(momentum[4], momentum.shape), rtol=5e-6)
    np.testing.assert_allclose(
        turns @ turns.transpose(0, 2, 1), np.broadcast_to(np.eye(3), turns.shape), atol=1e-9
    )
    e = 1e-4
    (a, b, c), (_, _, w) = (
        x[0] for x in rotate(R[None], motion.spin[None], inertia, np.array([0.3 + e, 0.3 - e, 0.3]))
    )
    np.testing.assert_allclose(Rotation.from_matrix(a @ b.T).as_rotvec() / (2 * e), w, rtol=1e-5)
    np.testing.assert_allclose(turns[4], R, atol=1e-9)


def test_the_grid_leaves_no_rotation_far_from_it():
    grid, some = spread_rotations(600), Rotation.random(300, random_state=0).as_matrix()
    nearest = [angle_between(grid, each).min() for each in some]
    assert np.degrees(max(nearest)) < 25


@pytest.mark.parametrize("count", [1, 4, 9, 16])
def test_moved_gaussians_look_like_those_at_rest_from_a_moved_camera(count):
    means, covars, opacities, sh, viewmats, Ks = random_scene(1, 20, 1, 40, 30, count)
    R = torch.tensor(Rotation.random(random_state=2).as_matrix())
    t = torch.tensor([0.1, -0.05, 0.08], dtype=torch.float64)
    generator = torch.Generator().manual_seed(1)
    quats = torch.rand(20, 4, generator=generator, dtype=torch.float64) - 0.5
    scales = 0.01 + 0.03 * torch.rand(20, 3, generator=generator, dtype=torch.float64)
    rest = Gaussians(means[0], quats, scales, opacities, sh[:, :1], sh[:, 1:])
    there = moved(rest, R, t)
    motion = torch.eye(4, dtype=torch.float64)
    motion[:3, :3], motion[:3, 3] = R, t
    pictures = [
        rasterize(g.means[None], g.covars()[None], g.opacities, g.sh(), view, Ks, 40, 30)[0]
        for g, view in ((rest, viewmats @ motion), (there, viewmats))
    ]
    torch.testing.assert_close(*pictures, rtol=0, atol=1e-9)
