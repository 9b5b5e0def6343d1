"""A track that continues with something else ends there, with the reason; a fixed camera that moves is named."""

import weakref
from collections.abc import Sequence

import numpy as np
import pytest

from neuma_lib.capture.frames import StoredPictures
from tests.support.drawn_falls import CONTACT, COUNT, HEIGHT, TIMES, WIDTH, ellipse, film, places, texture
from tests.support.errors import refused

pytest.importorskip("cv2")

from neuma_lib.capture.masks.camera_motion import background_shift, check_fixed  # noqa: E402
from neuma_lib.capture.masks.continuity import Break, appearance, broken_frames, grouped  # noqa: E402
from neuma_lib.capture.masks.video_masks import MAX_FRAMES, find_flight_window, video_masks  # noqa: E402

RED, GREY = (225, 70, 40), (60, 64, 70)


def seen(place, rx=17.0, ry=13.0, colour=RED):
    """Appearance of an ellipse."""
    mask = ellipse(place, rx, ry)
    picture = np.where(mask[..., None], colour, 120).astype(np.uint8)
    return appearance(picture, mask)


def fall():
    return [seen(place) for place in places()]


def test_an_object_that_falls_bounces_and_is_squashed_continues():
    looks = fall()
    for i, flat in ((CONTACT, 0.8), (CONTACT + 1, 0.6), (CONTACT + 2, 0.75)):
        looks[i] = seen(places()[i] + (0, 13 * (1 - flat)), 17 / flat**0.5, 13 * flat)
    looks[COUNT - 1] = None
    assert broken_frames(looks, TIMES, (0, CONTACT - 1)) == []


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        (lambda place: seen(place + (90, 0)), "place"),
        (lambda place: seen(place, 26, 20), "area"),
        (lambda place: seen(place, 40, 5.5), "elongation"),
        (lambda place: seen(place, colour=GREY), "colours"),
    ],
)
def test_what_is_not_the_object_is_left_out_with_the_reason(change, reason):
    """From frame 22 on, and before frame 2: each cue alone is sufficient."""
    looks = fall()
    for i in (*range(22, COUNT), 0, 1):
        looks[i] = change(places()[i])
    broken = broken_frames(looks, TIMES, (4, CONTACT - 1))
    assert [i for i, _ in broken] == [0, 1, *range(22, COUNT)]
    assert reason in dict(broken)[22] and reason in dict(broken)[1]
    looks[23:] = fall()[23:]  # a single frame
    single = broken_frames(looks, TIMES, (4, CONTACT - 1))
    assert [i for i, _ in single if i > 2] == [22]
    first, last = grouped(broken)[0], grouped(broken)[-1]
    assert (first.first, last.last) == (0, COUNT - 1)
    assert "frame 3: jumps" in str(Break(3, 3, "jumps"))


def test_the_track_does_not_continue_with_a_ruler():
    """Failed before: the ball is caught at frame 20, and the mask went on with the ruler next to it."""
    background = texture()
    frames = film(background)
    empty = np.rint(background).astype(np.uint8)
    rest = places()[CONTACT]
    x, y = np.meshgrid(np.arange(WIDTH), np.arange(HEIGHT))
    ruler = (np.abs(x - rest[0] - 34) < 55) & (np.abs(y - rest[1] - 12) < 5)
    for i, frame in enumerate(frames):
        if i > CONTACT:
            frame[ellipse(rest, 20, 16)] = empty[ellipse(rest, 20, 16)]
            frame[ruler] = (235, 235, 225)
    result = video_masks(frames, "drop.mp4", empty, TIMES)
    used = np.flatnonzero(result.masks.any(axis=(1, 2)))
    assert used[0] == 0 and used[-1] == CONTACT
    (left_out,) = {b.reason for b in result.breaks[:1]}
    assert result.breaks[-1].last == COUNT - 1 and result.breaks[0].first == CONTACT + 1
    assert "elongation" in left_out or "place" in left_out or "colours" in left_out


def test_only_the_frames_near_the_flight_are_masked():
    """A second of rest before and after the fall; at a high rate frames are thinned out."""
    background = texture()
    frames = film(background)
    empty = np.rint(background).astype(np.uint8)
    video = [empty] * 60 + frames + [frames[-1]] * 120
    times = np.arange(len(video)) / 60
    window = find_flight_window(iter(video), empty, times, 0.7)
    assert 54 <= window[0] <= 60 and 60 + CONTACT < window[-1] <= 60 + 0.7 * 60 + 1
    fast = find_flight_window(iter(video), empty, times / 40, 0.7)
    assert len(fast) <= MAX_FRAMES
    nothing = find_flight_window(iter([empty] * 9), empty, times[:9], 0.7)
    assert nothing[0] == 0


def test_a_camera_that_moves_is_named():
    background = np.rint(texture()).astype(np.uint8)
    frames = film(texture())
    still = [background_shift(background, frame) for frame in frames[::5]]
    assert check_fixed(still, range(0, COUNT, 5), WIDTH, "drop.mp4") < 0.001
    shaken = [np.roll(frame, round(3 * np.sin(i)), axis=1) for i, frame in enumerate(frames)]
    shifts = [background_shift(background, frame) for frame in shaken]
    np.testing.assert_allclose(shifts[1:4], [3, 3, 0], atol=0.3)
    with refused("drop.mp4", problem="the camera moves during the video"):
        check_fixed(shifts, range(COUNT), WIDTH, "drop.mp4")
    moved = [background_shift(background, np.roll(frame, 5, axis=0)) for frame in frames]
    with refused(
        "drop.mp4", problem="the camera was moved between the picture of the empty scene and the video"
    ):
        check_fixed(moved, range(COUNT), WIDTH, "drop.mp4")
    plain = np.full_like(background, 90)
    assert np.isnan(background_shift(plain, plain))
    assert check_fixed([np.nan], [0], WIDTH, "drop.mp4") == 0


class Counted(Sequence):
    """Pictures that are made when they are used, and how many of them existed at the same time."""

    def __init__(self, make, count):
        self.make, self.count, self.made, self.most = make, count, [], 0

    def __len__(self):
        return self.count

    def __getitem__(self, i):
        picture = self.make(i)
        self.made = [ref for ref in self.made if ref() is not None] + [weakref.ref(picture)]
        self.most = max(self.most, len(self.made))
        return picture


def test_a_few_pictures_of_a_video_are_in_memory_at_a_time():
    """Failed before: all frames and the background of each, 6.7 GB for 720 frames of 800 x 600 pixels."""
    frames, empty = film(texture()), np.rint(texture()).astype(np.uint8)
    video = Counted(lambda i: frames[i].copy(), COUNT)
    find_flight_window((video[i] for i in range(COUNT)), empty, TIMES, 0.7)
    assert video.most <= 3
    video_masks(video, "drop.mp4", empty, TIMES)
    assert video.most <= 4


def test_stored_pictures_are_those_that_were_given():
    rng = np.random.default_rng(0)
    pictures = rng.integers(0, 255, (5, 6, 8, 3)).astype(np.uint8)
    stored = StoredPictures(iter(pictures))
    assert len(stored) == 5 and stored.shape == (6, 8, 3)
    for k in (4, 0, 2):
        np.testing.assert_array_equal(stored[k], pictures[k])
    np.testing.assert_array_equal(np.stack(list(stored)), pictures)
    with pytest.raises(IndexError):
        stored[5]
