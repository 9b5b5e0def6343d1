"""Contact of balls with the floor: known stiffness, a bound if frames do not show it, and a simulated ball."""

import numpy as np
import pytest
import torch

from neuma_lib.mechanics.analytic import analytic_law
from neuma_lib.sim.colliders import Collider, contact_radius
from neuma_lib.sim.model import MPM
from neuma_lib.sim.rollout import rollout
from neuma_lib.sim.state import State
from tests.support.bouncing_balls import cut_disc, hertz_motion, rise
from tests.support.contact_scenes import sphere
from tests.support.sim_scenes import DENSITY

cv2 = pytest.importorskip("cv2")

from neuma_lib.capture.motion.bounce import ends, measure_bounce  # noqa: E402

RADIUS, SCALE = 0.03, 0.001  # [m], length of a pixel [m]
FALL, STIFFNESS = 0.0734, 526.0  # 1.2 m/s and 12 ms of contact, flattened by 0.16 of the radius


def bounce(rate, phase=0.0, stiffness=STIFFNESS, restitution=1.0, exposure=0.0, rows=150):
    """A ball filmed at (k + phase) / rate until it is high again. Blurred silhouettes are all places of an exposure."""
    times = (np.arange(round(0.24 * rate)) + phase) / rate
    y, v = hertz_motion(times, RADIUS, FALL, stiffness, restitution)
    masks = np.zeros((len(times), 150, 100), bool)
    for shift in np.linspace(-0.5, 0.5, 9 if exposure else 1):
        moved = hertz_motion(np.maximum(times + shift * exposure, 0), RADIUS, FALL, stiffness, restitution)[0]
        masks |= [cut_disc((50.3, 139.6 - each / SCALE), RADIUS / SCALE, 139.6, (150, 100)) for each in moved]
    masks, seen = masks[:, :rows], y > max(RADIUS, (139.6 - rows) * SCALE + RADIUS)
    flying = [np.flatnonzero(seen & way) for way in ((v <= 0) & (times < 0.15), v > 0)]
    return measure_bounce([rise(times, masks, k) for k in flying], flying, masks, times, SCALE, 0.0)


def test_the_ends_of_a_disc_are_those_that_were_drawn():
    """To half a pixel, by which an edge is rounded."""
    for x, y, radius in [(50.3, 60.2, 30.0), (41.0, 47.7, 12.4), (30.6, 33.1, 7.9)]:
        low, high = ends(cut_disc((x, y), radius, 200, (140, 100)))
        assert low == pytest.approx(-y - radius, abs=0.5) and high == pytest.approx(radius - y, abs=0.5)


@pytest.mark.parametrize("restitution", [1.0, 0.8])
def test_a_soft_ball_filmed_at_240_a_second_shows_its_stiffness(restitution):
    """The band contains the truth, at any time of the frames.

    The row of the floor is rounded by up to 0.5 px. The parabolas meet I d = 7.1 px below the height of first contact,
    so this is 7 % of the duration and 2.5 times as much, 17 %, of the stiffness. With losses, the stiffness is that of
    the way down times the restitution.
    """
    for phase in (0.0, 0.3, 0.7):
        seen = bounce(240, phase, restitution=restitution)
        assert seen["frames_of_contact"] in (2, 3)
        low, middle, high = seen["modulus_per_density_m2_s2_band"]
        assert low < STIFFNESS < high
        assert middle == pytest.approx(STIFFNESS * restitution, rel=0.17)
        # Gravity takes part of the energy on the way up: v2^2 = e^2 v1^2 - (1 - e^2) 2 g d.
        left = restitution**2 - (1 - restitution**2) * 0.16 * RADIUS / FALL
        assert seen["restitution_band"][1] == pytest.approx(left**0.5, abs=0.01)
        flattening = seen["flattening_of_radius_band"][2] * RADIUS
        assert 0.5 * flattening < seen["largest_flattening_seen_m"] < flattening


@pytest.mark.parametrize(
    ("rate", "exposure", "value"), [(240, 0.002, True), (120, 0.006, True), (60, 0.014, False)]
)
def test_an_exposure_longer_than_the_contact_leaves_a_bound(rate, exposure, value):
    """Of 12 ms. Half of the exposure is the slope of a length over the speed, which changes by 1 m/s: 1 ms for half a
    pixel. Of the blur next to the contact, the floor cuts a part.
    """
    seen = bounce(rate, 0.5, exposure=exposure)
    assert seen["exposure_s"] == pytest.approx(exposure, abs=1e-3 + 0.1 * exposure)
    low, _, high = seen["modulus_per_density_m2_s2_band"]
    assert low < STIFFNESS and (high is not None) == value
    assert not value or STIFFNESS < high


@pytest.mark.parametrize(("rate", "stiffness"), [(60, 4e4), (240, 4e4), (240, 4e5)])
def test_a_stiff_ball_shows_a_lower_bound(rate, stiffness):
    for phase in (0.0, 0.25, 0.5, 0.75):
        seen = bounce(rate, phase, stiffness, restitution=0.75)
        low, middle, high = seen["modulus_per_density_m2_s2_band"]
        assert middle is high is None and 0 < low < stiffness
        assert seen["restitution_band"][1] == pytest.approx(0.75, abs=0.01)


def test_the_border_of_the_picture_is_no_floor():
    seen = bounce(240, rows=128)
    low, middle, _ = seen["modulus_per_density_m2_s2_band"]
    assert seen["frames_of_contact"] == 0 and middle is None and 0 < low < STIFFNESS


def test_a_ball_that_is_too_small_has_no_constants():
    times = np.arange(20) / 60
    y, v = hertz_motion(times, 0.004, FALL, STIFFNESS)
    masks = [cut_disc((50.3, 139.6 - each / SCALE), 4.0, 139.6, (140, 100)) for each in y]
    flying = [
        np.flatnonzero((y > 0.004) & way) for way in ((v <= 0) & (times < 0.15), (v > 0) & (times < 0.24))
    ]
    rises = [rise(times, masks, k) for k in flying]
    assert measure_bounce(rises, flying, np.array(masks), times, SCALE, 0.0) is None


@pytest.mark.slow
def test_a_simulated_ball_shows_its_stiffness():
    """A neo-Hookean sphere with a radius of 11.5 cells, flattened by 0.15 of it. The floor is seen edge on.

    On this grid the time of contact is within 10 % of Hertz's (tests/sim/test_contact_physics.py), so the stiffness is
    within 25 %.
    """
    E, nu, radius, floor, scale, dt, every = 1e6, 0.3, 0.12, 0.05, 0.002, 1 / 16000, 64
    plane = Collider.plane((0.0, floor, 0.0), (0.0, 1.0, 0.0))
    model = MPM(96, dt, gravity=(0.0, -3.0, 0.0), contact="particles", colliders=(plane,))
    law = analytic_law({"elasticity": {"name": "neo_hookean", "E": E, "nu": nu}}, dt)
    x, mass, vol0 = (value.float() for value in sphere(radius, 0.5 / 96, (0.5, 0.5, 0.5)))
    size = float(contact_radius(vol0)[0])
    x[:, 1] += floor + size + 0.06 - x[:, 1].min()
    start = State(x, torch.tensor((0.0, -1.5, 0.0)), mass, vol0)
    path = rollout(model, law, start, steps=35 * every, frames=range(0, 35 * every + 1, every))
    times, masks = np.arange(36) * every * dt, []
    for frame in path.x.numpy():
        picture = np.zeros((260, 220), np.uint8)
        for place in (np.stack([frame[:, 0] - 0.28, 0.5 - frame[:, 1]], axis=1) / scale * 16).astype(int):
            cv2.circle(picture, place.tolist(), round(16 * size / scale), 1, -1, shift=4)
        picture = cv2.morphologyEx(picture, cv2.MORPH_CLOSE, np.ones((5, 5), np.uint8))
        picture[round((0.5 - floor) / scale) :] = 0
        masks.append(picture.astype(bool))
    free = path.x[:, :, 1].amin(dim=1).numpy() - size - floor > 1e-3
    flying = [
        np.flatnonzero(free & way) for way in (np.arange(36) < free.argmin(), np.arange(36) > free.argmin())
    ]
    rises = [rise(times, masks, k) for k in flying]
    seen = measure_bounce(rises, flying, np.array(masks), times, scale, 0.0)
    low, middle, high = seen["modulus_per_density_m2_s2_band"]
    truth = E / (1 - nu**2) / DENSITY
    assert low < truth < high
    assert middle == pytest.approx(truth, rel=0.25)
