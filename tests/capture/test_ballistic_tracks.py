"""Ballistic tracks among candidates: regions on a parabola are detected, others are not."""

import numpy as np

from neuma_lib.capture.motion.ballistic_tracks import find_ballistic_tracks

TIMES = np.arange(40) / 60.0


def flight(t, x=100.0, y=50.0, vx=80.0, vy=-20.0, a=2000.0):
    return np.stack([x + vx * t, y + vy * t + a * t * t / 2], axis=1)


def candidates(*tracks, noise=0.0, seed=0):
    """Tracks are (T, 2) with NaN where nothing is seen, and an area."""
    rng = np.random.default_rng(seed)
    frames = []
    for i in range(len(TIMES)):
        rows = [
            [*(track[i] + noise * rng.normal(size=2)), area]
            for track, area in tracks
            if np.isfinite(track[i, 0])
        ]
        frames.append(np.array(rows).reshape(-1, 3))
    return frames


def test_the_track_is_detected_next_to_a_larger_hand_and_flicker():
    ball = flight(TIMES)
    hand = np.stack([300 + 150 * np.sin(9 * TIMES), 200 + 90 * np.cos(14 * TIMES)], axis=1)
    flicker = np.random.default_rng(1).uniform(0, 400, (40, 2))
    (first, *others) = find_ballistic_tracks(
        candidates((hand, 9000.0), (ball, 500.0), (flicker, 400.0), noise=0.3), TIMES
    )
    assert first.frames == (0, 39) and len(first.candidates) >= 38 and not others
    assert all(number == 1 for number in first.candidates.values())  # its number among the candidates
    # noise of 0.3 px on 40 places: a place at the middle of the fit is known to about 0.3 * 3 / sqrt(40) px
    np.testing.assert_allclose(first.place(TIMES[20]), ball[20], atol=0.5)


def test_what_rolls_on_a_line_is_no_flight_next_to_one():
    """It is seen longer than the object, and its path is curved a little: by perspective, or by noise."""
    ball = flight(TIMES)
    ball[15:] = np.nan
    rolling = flight(TIMES, x=300.0, vx=90.0, vy=-9.0, a=10.0)
    seen = candidates((rolling, 700.0), (ball, 500.0), noise=0.3)
    (track,) = find_ballistic_tracks(seen, TIMES, down=np.array([0.0, 1.0]))
    assert track.frames == (0, 14) and set(track.candidates.values()) == {1}
    (alone,) = find_ballistic_tracks(candidates((rolling, 700.0), noise=0.3), TIMES)
    assert alone.frames == (0, 39)  # with nothing else in motion, the flight may be too short to be curved


def test_a_bounce_makes_two_tracks_in_the_order_of_time():
    down, up = flight(TIMES[:20], vy=0), flight(TIMES[:20], y=0.0, vy=-600.0)
    up[:, 1] += down[-1, 1]
    tracks = find_ballistic_tracks(candidates((np.concatenate([down, up]), 500.0)), TIMES)
    assert len(tracks) == 2
    # a frame next to the impact may lie near enough to both
    assert abs(tracks[0].frames[1] - 19) <= 1 and abs(tracks[1].frames[0] - 20) <= 1


def test_a_soft_bounce_is_no_flight():
    """Fall, contact of 24 frames, and rebound: seen as one, they keep to a parabola that is curved upward."""
    times = np.arange(60) / 120.0
    a, speed, contact = 1200.0, 300.0, 0.2
    fall = times < 0.15
    y = np.where(fall, speed * (times - 0.15) + a * (times - 0.15) ** 2 / 2, 0.0)
    after = times - 0.15 - contact
    y = np.where(~fall & (after < 0), speed * contact / np.pi * np.sin(np.pi * (times - 0.15) / contact), y)
    y = np.where(after >= 0, -speed * after + a * after**2 / 2, y)
    body = np.stack([100.0 + 20 * times, 200 + y], axis=1)
    seen = [np.array([[*place, 700.0]]) for place in body]
    (longest,) = sorted(find_ballistic_tracks(seen, times), key=lambda track: len(track.candidates))[-1:]
    assert longest.frames[0] < 18 < 42 < longest.frames[1] and longest.coefficients[2, 1] < 0
    first, *_ = tracks = find_ballistic_tracks(seen, times, down=np.array([0.1, 0.9]))
    assert all(track.coefficients[2, 1] > 0 for track in tracks)
    assert (
        first.frames[0] == 0 and sum(first.frames) / 2 < 18
    )  # its middle, where the fit begins, is in the fall


def test_missed_frames_are_bridged():
    ball = flight(TIMES)
    ball[[10, 11, 25]] = np.nan
    (track,) = find_ballistic_tracks(candidates((ball, 500.0)), TIMES)
    assert track.frames == (0, 39) and 10 not in track.candidates and len(track.candidates) == 37


def test_times_that_vary_do_not_break_a_track():
    times = TIMES + 0.006 * np.random.default_rng(0).uniform(-1, 1, len(TIMES))
    (track,) = find_ballistic_tracks(candidates((flight(times), 500.0)), times)
    assert track.frames == (0, 39)
    np.testing.assert_allclose(track.place(times), flight(times), atol=1e-6)


def test_what_rests_or_moves_at_random_is_no_flight():
    rest = np.tile([200.0, 300.0], (40, 1))
    walk = np.cumsum(np.random.default_rng(0).normal(0, 25, (40, 2)), axis=0)
    assert find_ballistic_tracks(candidates((rest, 500.0), (walk, 300.0), noise=0.3), TIMES) == []


def test_what_changes_its_size_is_another_object():
    ball = flight(TIMES)
    frames = candidates((ball, 500.0))
    for i in range(0, 40, 2):
        frames[i][:, 2] = 5000.0
    assert all(len(track.candidates) <= 20 for track in find_ballistic_tracks(frames, TIMES))
