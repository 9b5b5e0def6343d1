"""Gravity from tracks: exact without noise, unbiased with it, and what a wrong time base or scale does."""

from dataclasses import replace

import numpy as np
import pytest

from neuma_lib.capture.motion.free_fall import Track, fit_flight, fit_free_fall
from neuma_lib.capture.motion.gravity import GRAVITY, UP, Gravity
from neuma_lib.capture.motion.timing import row_times
from neuma_lib.errors import InputError
from tests.support.board_pictures import looking_at
from tests.support.errors import refused

X0, V0, A = np.array([0.1, 1.2, 0.0]), np.array([0.4, 0.3, -0.2]), np.array([0.0, -GRAVITY, 0.0])
K = np.array([[800.0, 0, 320], [0, 800, 240], [0, 0, 1]])


def track(position, offset=0.0, noise=0.0, rng=None, v0=V0, stretch=1.0, count=40):
    t = np.arange(count) / 120
    x = X0 + v0 * t[:, None] + A * t[:, None] ** 2 / 2
    view = looking_at(position, (0.1, 0.8, 0), UP)
    p = (x @ view[:3, :3].T + view[:3, 3]) @ K.T
    places = p[:, :2] / p[:, 2:]
    if noise:
        places = places + rng.normal(0, noise, places.shape)
    return Track(5 + t * stretch - offset, places, view, K, f"{position}.mp4")


def two(**options):
    return [track((2.0, 1.0, 0.3), **options), track((0.2, 1.1, 2.2), **{**options, "offset": 0.004})]


def test_without_noise_the_motion_and_the_offset_are_exact():
    fall = fit_free_fall(two())
    np.testing.assert_allclose(np.stack([fall.x0, fall.v0, fall.a]), [X0, V0, A], atol=1e-5)
    np.testing.assert_allclose(fall.offsets, [0, 0.004], atol=1e-7)
    assert fall.views == "triangulated" and fall.gravity.check("drop")


def test_with_noise_the_fit_is_unbiased_and_its_covariance_holds():
    rng = np.random.default_rng(1)
    z = []
    for _ in range(100):
        fall = fit_free_fall(two(noise=0.5, rng=rng))
        error = np.concatenate([fall.x0 - X0, fall.v0 - V0, fall.a - A, fall.offsets[1:] - 0.004])
        z.append(error / np.sqrt(np.diag(fall.covariance)))
    z = np.array(z)
    # mean of 100 unit normals: deviation 0.1; their standard deviation: 1 / sqrt(200) = 0.07
    assert np.abs(z.mean(axis=0)).max() < 0.4
    assert 0.72 < z.std(axis=0).min() and z.std(axis=0).max() < 1.28


def test_a_time_base_off_by_3_percent_shows_as_6_percent_in_gravity():
    fall = fit_free_fall([track((2.0, 1.0, 0.3), stretch=1.03), track((0.2, 1.1, 2.2), stretch=1.03)])
    assert fall.gravity.ratio[0] == pytest.approx(1.03**-2, abs=1e-4)


def test_one_camera_measures_gravity_in_the_plane_of_the_fall():
    flat = np.array([0.4, 0.3, 0.0])
    one = track((0.2, 1.1, 2.2), v0=flat)
    fall = fit_free_fall([one], plane=(X0, np.array([0.0, 0, 1])))
    np.testing.assert_allclose(np.stack([fall.v0, fall.a]), [flat, A], atol=1e-5)
    assert fall.views == "one view in a plane" and fall.gravity.angle()[0] < 1e-3
    with refused("plane"):
        fit_free_fall([one])


def test_a_mismatch_names_the_likely_causes():
    slow = fit_free_fall([track((2.0, 1.0, 0.3), stretch=4.0), track((0.2, 1.1, 2.2), stretch=4.0)])
    with pytest.raises(InputError, match=r"(?s)square size.*frame rate is 4\.00.*time base.*row_time"):
        slow.gravity.check("drop")
    with pytest.raises(InputError, match="drop: .*floor or board"):
        fit_free_fall(two()).gravity.check("drop", normal=(0.2, 1.0, 0.0))


def test_a_wrong_square_size_shows_as_its_share_of_gravity():
    """A square stated 1.2 times too large makes the whole room so: also the way to the cameras."""
    tracks = two()
    for seen in tracks:
        seen.viewmat[:3, 3] *= 1.2
    fall = fit_free_fall(tracks)
    assert fall.gravity.ratio[0] == pytest.approx(1.2, abs=1e-5)
    with pytest.raises(InputError, match=r"square size is 0\.83 of"):
        fall.gravity.check("drop")


def test_too_few_frames_are_refused():
    with refused("(2.0, 1.0, 0.3).mp4"):
        fit_free_fall([track((2.0, 1.0, 0.3), count=3)])


def test_frames_of_the_hand_and_of_the_contact_are_left_out():
    rng = np.random.default_rng(2)
    tracks = two(noise=0.2, rng=rng)
    for track, first, last in zip(tracks, (3, 5), (36, 35)):
        track.places[:first] = track.places[first]  # held
        track.places[last:] += 3.0 * np.arange(1, 41 - last)[:, None] * (0.2, -1)  # stopped by the floor
    fall, kept = fit_flight(tracks)
    # a frame next to them that is off by as little as the noise may stay
    assert np.abs(np.subtract([(k.start, k.stop) for k in kept], [(3, 36), (5, 35)])).max() <= 1
    assert abs(fall.gravity.ratio[0] - 1) < 4 * fall.gravity.ratio[1] < 0.1
    spoiled = fit_free_fall(tracks)
    assert abs(spoiled.gravity.ratio[0] - 1) > 0.1 > abs(fall.gravity.ratio[0] - 1)


def test_videos_of_different_takes_are_refused():
    tracks = [track((2.0, 1.0, 0.3)), track((0.2, 1.1, 2.2), v0=np.array([-1.5, 2.5, 0.7]))]
    with refused("(2.0, 1.0, 0.3).mp4", "(0.2, 1.1, 2.2).mp4"):
        fit_flight(tracks)


def test_what_a_large_object_may_be_off_is_still_refused_by_gravity():
    """Silhouettes of a body of 40 px may deviate by 4 px. Different takes that fit so well contradict gravity."""
    rng = np.random.default_rng(0)
    count = 0
    for _ in range(20):
        tracks = [track((2.0, 1.0, 0.3)), track((0.2, 1.1, 2.2), v0=V0 + rng.normal(scale=0.7, size=3))]
        try:
            fit_flight(tracks)
        except InputError:
            count += 1
            with pytest.raises(InputError):
                fall, _ = fit_flight([replace(each, radius=40.0) for each in tracks])
                fall.gravity.check("drop")
    assert count >= 3
    fall, _ = fit_flight([replace(each, radius=40.0) for each in (
        track((2.0, 1.0, 0.3)), track((0.2, 1.1, 2.2), v0=np.array([-1.5, 2.5, 0.7]))
    )])  # fmt: skip
    assert 0.004 * 480 < fall.rms < 4.0


def test_a_fixed_offset_is_kept():
    fall = fit_free_fall(two(), offsets=[0, 0.004], fixed=[False, True])
    np.testing.assert_array_equal(fall.offsets, [0, 0.004])
    assert fall.gravity.ratio[0] == pytest.approx(1, abs=1e-6) and fall.covariance[9, 9] == 0
    far = fit_free_fall(two(), offsets=[0, 0.03])  # the beginning, a few frames off, does not matter
    assert far.offsets[1] == pytest.approx(0.004, abs=1e-6)


def test_the_deviation_of_gravity_is_that_of_the_closed_form():
    # x(t) = x0 + v0 t + a t^2 / 2 from N places over T seconds: sigma_a = sigma_x sqrt(720 / N) / T^2. The camera looks
    # across the fall from 2.1 m, so that a pixel is 2.1 / 800 m.
    count, noise = 40, 0.3
    rng = np.random.default_rng(0)
    flat = np.array([0.4, 0.3, 0.0])
    results = []
    for _ in range(30):
        one = track((0.1, 0.8, 2.1), v0=flat, noise=noise, rng=rng, count=count)
        results.append(fit_free_fall([one], plane=(X0, np.array([0.0, 0, 1]))).gravity.ratio[1])
    expected = noise * 2.1 / 800 * np.sqrt(720 / count) / ((count - 1) / 120) ** 2 / GRAVITY
    assert np.mean(results) == pytest.approx(expected, rel=0.1)


def test_a_rolling_shutter_is_undone_by_the_times_of_the_rows():
    row_time, rows = 15e-6, 960
    tracks = []
    for whole in two():
        # What a shutter saw at time t lies where it was row_time * y later; two rounds are exact to far below a row.
        places = whole.places
        for _ in range(4):
            t = (row_times(whole.times, places[:, 1], row_time, 480, rows) - whole.times)[:, None]
            offset = 0.004 if whole.viewmat[2, 3] != two()[0].viewmat[2, 3] else 0.0
            fall_t = whole.times[:, None] - 5 + t + offset
            x = X0 + V0 * fall_t + A * fall_t**2 / 2
            p = (x @ whole.viewmat[:3, :3].T + whole.viewmat[:3, 3]) @ whole.K.T
            places = p[:, :2] / p[:, 2:]
        tracks.append(Track(whole.times, places, whole.viewmat, whole.K, whole.name))
    assert abs(fit_free_fall(tracks).gravity.ratio[0] - 1) > 0.02
    undone = [
        Track(row_times(t.times, t.places[:, 1], row_time, 480, rows), t.places, t.viewmat, t.K, t.name)
        for t in tracks
    ]
    fall = fit_free_fall(undone)
    assert fall.gravity.ratio[0] == pytest.approx(1, abs=1e-4)
    assert fall.offsets[1] == pytest.approx(0.004, abs=1e-5)


def wandering(rng, alike, deviation=1.0, frames=40):
    """Noise of which neighbours have that correlation, (frames, 2) [px]."""
    noise = rng.normal(0, deviation, (frames, 2))
    for k in range(1, frames):
        noise[k] = alike * noise[k - 1] + np.sqrt(1 - alike**2) * noise[k]
    return noise


def test_the_deviation_holds_where_neighbouring_frames_are_off_alike():
    """The middle of an outline wanders; as if every frame were on its own, gravity would look three times as sure."""
    rng = np.random.default_rng(4)
    z, alone = [], []
    for _ in range(60):
        tracks = [replace(each, places=each.places + wandering(rng, 0.8)) for each in two()]
        gravity = fit_free_fall(tracks).gravity
        z.append((gravity.a - A) / np.sqrt(np.diag(gravity.covariance)))
        shuffled = [replace(each, places=each.places + rng.normal(0, 1, each.places.shape)) for each in two()]
        alone.append(gravity.ratio[1] / fit_free_fall(shuffled).gravity.ratio[1])
    assert 0.6 < np.std(z) < 1.6
    assert np.median(alone) > 1.5


def test_a_soft_contact_that_looks_like_flight_is_left_out_once_it_is_known():
    rng = np.random.default_rng(5)
    spoiled, mended, late = [], [], np.maximum(np.arange(40) - 30, 0)[:, None]
    for _ in range(20):
        tracks = [
            replace(each, places=each.places + wandering(rng, 0.8) + late**2 * (0.0, -0.25), radius=40.0)
            for each in two()
        ]
        fall, kept = fit_flight(tracks)
        assert max(k.stop for k in kept) > 32
        spoiled.append(fall.gravity.ratio[0] - 1)
        fall, kept = fit_flight(tracks, offsets=[0, 0.004], contact=5 + 30.5 / 120)
        assert max(k.stop for k in kept) <= 31
        mended.append(fall.gravity.ratio[0] - 1)
    assert np.mean(spoiled) < -0.015 and abs(np.mean(mended)) < 0.4 * abs(np.mean(spoiled))
    _, kept = fit_flight(tracks, contact=5 + 2 / 120)  # too early for a flight: the floor is elsewhere
    assert max(k.stop for k in kept) > 32


def test_a_mismatch_that_is_not_sure_is_left_to_a_better_measurement():
    sure = Gravity(np.array([0.0, -0.86 * GRAVITY, 0.0]), np.eye(3) * (0.01 * GRAVITY) ** 2, "outlines")
    unsure = replace(sure, covariance=np.eye(3) * (0.03 * GRAVITY) ** 2)
    assert sure.mismatch() == pytest.approx((0.14, 0.01))
    for gravity, tolerated in ((sure, 0.0), (sure, 2.0), (unsure, 0.0)):
        with pytest.raises(InputError, match="square size is 1.16"):
            gravity.check("drop", tolerated=tolerated)
    assert "within its uncertainty" in unsure.check("drop", tolerated=2.0)
