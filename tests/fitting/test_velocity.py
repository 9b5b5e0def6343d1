"""Initial velocity from images: exact where the model is, honest about depth."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from neuma_lib.config.velocity import VelocityConfig
from neuma_lib.coupling.initial_motion import InitialMotion
from neuma_lib.coupling.particle_gs import ParticleGS
from neuma_lib.fitting.velocity import UNKNOWNS, _Flight, estimate_velocities, estimate_velocity
from neuma_lib.mechanics.analytic import analytic_law
from neuma_lib.sim.clamps import Clamp
from neuma_lib.sim.model import contact_clearance
from neuma_lib.sim.rollout import rollout
from neuma_lib.sim.state import State
from neuma_lib.splatting.observation import Observation
from tests.support.errors import refused
from tests.support.grounding_scene import MODEL, PRIOR, RADIUS, TRUTH, ball, camera, observe

FRAMES = (0, 4, 8, 12, 16, 20, 60)


def estimate(body, observation, **options):
    return estimate_velocity(
        MODEL, analytic_law(PRIOR, MODEL.dt), body, observation, VelocityConfig(**options)
    )


def simulated(law, body, frames, spin):
    """Free flight of the body, simulated with the spin [rad/s]."""
    flight = _Flight(MODEL, law, body, frames)
    unknowns = np.zeros(UNKNOWNS)
    unknowns[3:6] = np.asarray(spin) / flight.units[3:6]
    flight.simulate(unknowns, frames)
    return flight


def test_recovers_an_oblique_launch_from_its_own_renders():
    body = ball()
    v0 = np.array([0.5, -1.2, 0.4])
    motion = estimate(body, observe(body, v0, FRAMES), ridge=0.0)
    assert np.abs(motion.v0 - v0).max() < 1e-4
    assert motion.frames[-1] < 60, "frames after contact must not be used"
    assert not motion.spin.any(), "a body that does not spin starts with one velocity"
    kept = estimate(body, observe(body, v0, FRAMES), ridge=0.0, spin_significance=0.0)
    assert np.abs(kept.v0 - v0).max() < 1e-4 and np.abs(kept.spin).max() < 1e-3


def test_a_spin_below_its_uncertainty_is_zero_and_one_above_is_estimated():
    """The angle that images leave open, over the time to contact, divides both; depth does not suffer from either."""
    body = ball()
    v0, duration = np.array([0.5, -1.2, 0.4]), 20 * MODEL.dt
    for angle, kept in ((0.01, False), (0.1, True)):
        spin = np.array([0.0, angle / duration, 0.0])
        motion = estimate(body, observe(body, v0, FRAMES, spin=spin), angle_std=0.01)
        assert motion.spin.any() == kept
        assert (np.abs(motion.spin - spin) < 2 * motion.spin_std).all()
        assert (motion.spin_std >= 0.01 / duration).all()
        assert np.abs(motion.v0 - v0).max() < 0.02


def test_few_frames_are_spread_over_the_flight():
    body = ball()
    v0 = np.array([0.5, -1.2, 0.4])
    motion = estimate(body, observe(body, v0, FRAMES), frames=3)
    assert motion.frames == (0, 8, 20) and np.abs(motion.v0 - v0).max() < 1e-4


def test_recovers_a_spinning_launch_of_another_material():
    """The prior is three times stiffer than what was filmed: both hardly stretch, and turn alike."""
    body = ball()
    v0, spin = np.array([0.5, -0.9, 0.4]), np.array([2.0, -3.0, 4.0])
    motion = estimate(body, observe(body, v0, FRAMES, spin=spin))
    # Centrifugal strain rho w^2 R^2 / E = 0.016 of the filmed ball, of which the prior's ball has a third.
    assert np.abs(motion.v0 - v0)[:2].max() < 0.01 * np.linalg.norm(v0)
    assert np.abs(motion.spin - spin).max() < 0.016 * np.linalg.norm(spin)
    np.testing.assert_allclose(motion.centre, (body.mass @ body.x0 / body.mass.sum()).numpy())


def test_the_flight_that_is_fitted_is_the_simulated_one():
    """Spinning in the middle and carried along a parabola, as against one simulation of it all.

    A stiff body on a grid turns a little differently where it lies differently among the nodes; the transfers are
    exact for its affine motion, so that only its strain, below 1e-3, meets the grid.
    """
    body, law = ball(), analytic_law(PRIOR, MODEL.dt)
    v0, spin = torch.tensor([0.5, -0.9, 0.4]).double(), torch.tensor([2.0, -3.0, 4.0]).double()
    frames = (0, 4, 8, 12)
    flight = simulated(law, body, frames, spin)
    x, F = flight(v0, spin, frames)
    with torch.no_grad():
        path = rollout(MODEL, law, body.state(v0, spin), steps=12, frames=frames)
    moved = (path.x - path.x[0]).norm(dim=-1).max()
    assert (x - path.x).norm(dim=-1).max() < 1e-3 * moved
    assert (F - path.F).norm(dim=(-1, -2)).max() < 1e-2
    # A spin from its neighbourhood is turned rigidly: an error of the angle between both times the angle turned.
    near, _ = simulated(law, body, frames, spin + 0.1)(v0, spin, frames)
    t = 12 * MODEL.dt
    assert (near - x).norm(dim=-1).max() < (0.1 * 3**0.5 * t) * float(spin.norm() * t) * RADIUS


def test_what_nothing_holds_flies_straight_on():
    """Looseness 1 turns the flight of a stiff body into that of free particles, but for the strain of the body.

    The ball's centrifugal strain is below rho w^2 R^2 / E = 0.0049, which moves its surface by less than 0.7 mm; loose
    and rigid flight are 1.1 mm apart at the last frame.
    """
    body = ball()
    v0, spin = torch.tensor([0.5, -0.9, 0.4]).double(), torch.tensor([2.0, -3.0, 4.0]).double()
    frames = (0, 6, 12)
    flight = simulated(analytic_law(PRIOR, MODEL.dt), body, frames, spin)
    start = body.state(v0, spin)
    x, F = flight(v0, spin, frames, (1.0, 0.0))
    for k, n in list(enumerate(frames))[1:]:
        t, fallen = n * MODEL.dt, torch.tensor(MODEL.gravity) * MODEL.dt**2 * n * (n + 1) / 2
        straight = body.x0 + t * start.v + fallen
        assert (x[k] - straight).norm(dim=1).max() < 0.0049 * RADIUS
        assert (F[k] - torch.eye(3) - t * start.C[0]).norm(dim=(-1, -2)).max() < 1e-2
    # Shrinking acts along the axis alone.
    shrunk = flight(v0, spin, frames, (1.0, 1.0))[0][-1] - x[-1]
    axis, r, t = spin / spin.norm(), body.x0 - flight.centre, frames[-1] * MODEL.dt
    torch.testing.assert_close(shrunk, -(spin.norm() ** 2) * t**2 / 2 * (r @ axis)[:, None] * axis)


def test_depth_is_the_weakest_axis_and_the_ridge_acts_on_it_alone():
    body = ball()
    v0 = np.array([0.5, -1.2, 0.4])
    motion = estimate(body, observe(body, v0, FRAMES), ridge=0.05)
    assert motion.information[2] < 0.2 * motion.information[:2].min()
    assert np.abs(motion.v0 - v0)[:2].max() < 0.02
    assert 0 < motion.v0[2] < v0[2]


def test_another_sampling_of_the_body_gives_the_plane_within_two_percent():
    v0 = np.array([0.3, -1.4, 0.0])
    observation = observe(ball(seed=0), v0, FRAMES)
    other = ball(seed=0, count=500)  # same kernels are drawn first, other particles and binding
    motion = estimate(other, observation)
    assert np.abs(motion.v0 - v0)[:2].max() < 0.02 * np.linalg.norm(v0)


@pytest.mark.parametrize("correlated", [False, True], ids=["pixel noise", "patches that last"])
def test_uncertainty_covers_the_error_of_noisy_images(correlated):
    """Independent noise, and patches of 8 px that stay where they are over all frames.

    The root mean square of 8 independent errors of one standard deviation is below 0.2 or above 3 with a probability
    of 2.4e-5 (chi-squared distribution). Of 4 errors it would be 3e-3, for each of the unknowns.
    """
    body = ball()
    v0 = np.array([0.5, -1.2, 0.4])
    clean = observe(body, v0, FRAMES, size=64)
    noise = torch.Generator().manual_seed(3)
    errors, stds = [], []
    for _ in range(8):
        shape = (1, 1, 8, 8, 3) if correlated else clean.images.shape
        drawn = 0.05 * torch.randn(shape, generator=noise, dtype=torch.float64)
        if correlated:
            drawn = drawn.repeat_interleave(8, dim=2).repeat_interleave(8, dim=3)
        noisy = clean.colours() + drawn
        # The spin is kept, and the Gaussians are perfect: nothing but the noise of the images is left.
        options = dict(ridge=0.0, spin_significance=0.0, angle_std=0.0)
        motion = estimate(body, type(clean)(clean.frames, noisy, clean.cameras), **options)
        errors.append([*(motion.v0 - v0), *motion.spin])
        stds.append([*motion.std, *motion.spin_std])
    ratio = np.sqrt(np.mean(np.square(errors), 0)) / np.mean(stds, 0)
    assert (ratio < 3).all() and (ratio > 0.2).all()


def test_bytes_are_their_colours_and_few_frames_at_a_time_give_the_sums_of_all(monkeypatch):
    body = ball()
    clean = observe(body, [0.5, -1.2, 0.4], FRAMES)
    opaque = torch.ones_like(clean.images[..., :1])
    pixels = (255 * torch.cat([clean.images, opaque], -1).clamp(0, 1)).round().to(torch.uint8)
    decoded = Observation(clean.frames, pixels, clean.cameras)
    motion = estimate(body, decoded, ridge=0.0)
    assert motion.loss > 0
    monkeypatch.setattr(ParticleGS, "frames_per_batch", 2)
    again = estimate(body, Observation(clean.frames, decoded.colours(), clean.cameras), ridge=0.0)
    for name in ("v0", "std", "information", "loss"):
        np.testing.assert_allclose(getattr(again, name), getattr(motion, name), rtol=1e-6)


def test_a_clamped_body_is_at_rest():
    body, frames = ball(), tuple(range(0, 33, 4))
    held = replace(MODEL, clamps=(Clamp((0, 0.3, 0), (1, 1, 1)),))
    seen = observe(body, (0.0, 0.0, 0.0), frames, model=held)
    law = analytic_law(TRUTH, MODEL.dt)
    motion = InitialMotion.of(estimate_velocity(held, law, body, seen, VelocityConfig()).as_dict())
    assert not np.concatenate([motion.velocity, motion.spin, motion.std]).any()
    assert motion.centre == pytest.approx((body.mass @ body.x0 / body.mass.sum()).numpy())


def test_a_body_that_starts_in_contact_is_an_input_error():
    """The surface of its lowest particle is a tenth of a millimetre below the floor."""
    body = ball(height=RADIUS)
    body = ball(height=RADIUS - float(contact_clearance(MODEL, body.x0, body.vol0)) - 1e-4)
    assert float(body.x0[:, 1].min()) > 0
    observation = observe(body, [0.0, 0.0, 0.0], FRAMES)
    with refused("frames"):
        estimate(body, observation)


def test_several_bodies_fly_until_they_touch():
    """A ball that catches up with a slower one, next to which it hides a part of it. Frames of the contact would change
    the slower one's velocity."""
    bodies = [ball(height=0.75), ball(height=0.35, seed=1)]
    velocities, frames = [(0.3, -2.5, 0.0), (0.0, 0.5, 0.2)], tuple(range(0, 61, 6))
    law, cameras = analytic_law(PRIOR, MODEL.dt), camera()
    states = [body.state(v) for body, v in zip(bodies, velocities, strict=True)]
    run = dict(steps=frames[-1], frames=frames)
    path = rollout(MODEL, law, State.joined(states, separate=True), **run)
    x, F = (value.split([len(body.x0) for body in bodies], dim=1) for value in (path.x, path.F))
    renders = [body.particle_gs(cameras) for body in bodies]
    cover = [own.coverage(*state)[..., 0] for own, *state in zip(renders, x, F, strict=True)]
    videos = []
    for k in (0, 1):
        hidden = (cover[1 - k] > 0.05) & ((k == 1) | (cover[1 - k] > cover[k]))
        images = renders[k](x[k], F[k]).masked_fill(hidden[..., None], 1.0)
        videos.append([Observation(frames, images, cameras, hidden=hidden)])
    assert (videos[1][0].hidden & (cover[1] > 0.05)).any()
    motions = estimate_velocities(MODEL, law, bodies, videos, VelocityConfig(ridge=0.0))
    flights = [_Flight(MODEL, law, body, frames) for body in bodies]
    for motion, v in zip(motions, velocities, strict=True):
        assert np.abs(motion.v0 - v).max() < 0.02, motion.v0
        assert 3 <= len(motion.frames) < len(frames) - 2
    gaps = [
        float(torch.cdist(*(flight(*(torch.tensor(v).double() for v in (v0, (0.0, 0.0, 0.0))), (n,))[0][0]
              for flight, v0 in zip(flights, velocities, strict=True))).min())
        for n in motions[0].frames
    ]  # fmt: skip
    assert min(gaps) > 0
    alone = estimate(bodies[1], videos[1][0])
    errors = [abs(each.v0[1] - velocities[1][1]) for each in (alone, motions[1])]
    assert errors[0] > 3 * errors[1] and len(alone.frames) > len(motions[1].frames)
