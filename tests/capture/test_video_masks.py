"""Masks of a drawn fall with everything that a room adds; and messages for bad videos."""

import numpy as np
import pytest

from neuma_lib.errors import InputError
from tests.support.drawn_falls import (
    CONTACT,
    COUNT,
    TIMES,
    ellipse,
    film,
    film_of_contact,
    places,
    stony,
    texture,
)

pytest.importorskip("cv2")

from neuma_lib.capture.masks import background as backgrounds  # noqa: E402
from neuma_lib.capture.masks import video_masks as module  # noqa: E402
from neuma_lib.capture.masks.regions import MAX_MOVING, centroid, check_flight, iou  # noqa: E402
from tests.support.errors import refused  # noqa: E402

MIN_IOU = 0.96  # what the masks of the synthetic capture have to reach


def overlaps(result, frames=range(COUNT)):
    return [iou(result.masks[i], ellipse(places()[i])) for i in frames]


def test_a_fall_is_masked_with_shadow_drifting_exposure_and_noise():
    background = texture()
    frames = film(background, shadow=True, gain=(1.15, 1.1, 0.95))
    result = module.video_masks(frames, "drop.mp4", np.rint(background).astype(np.uint8), TIMES)
    assert min(overlaps(result)) > MIN_IOU
    # 800 pixels with an edge of some 95: half a pixel of random error along it moves the centre by less than 0.1
    np.testing.assert_allclose([centroid(mask) for mask in result.masks], places(), atol=0.3)
    # the flight ends within a frame of the contact, after which the parabola would go on
    assert len(result.tracks) == 1 and abs(result.tracks[0].frames[1] - CONTACT) <= 1
    assert result.moving.max() < MAX_MOVING
    jumps = check_flight(result.masks, "drop.mp4", range(CONTACT))
    assert jumps.max() < 0.06


def test_the_hand_that_lets_go_is_not_the_object():
    background = texture()
    result = module.video_masks(
        film(background, hand=True), "drop.mp4", np.rint(background).astype(np.uint8), TIMES
    )
    free = range(13, COUNT)
    assert min(overlaps(result, free)) > MIN_IOU
    # held, it is either left out, or found without the hand
    assert all(m.sum() < 2 * ellipse(p).sum() for m, p in zip(result.masks, places()))


def test_the_median_of_the_frames_stands_in_for_the_empty_picture():
    frames = film(texture())[: CONTACT + 1]
    result = module.video_masks(frames, "drop.mp4", times=TIMES[: CONTACT + 1])
    # while it is slow, at first, it covers a pixel in too many frames
    assert min(overlaps(result, range(10, CONTACT + 1))) > 0.9


def test_a_place_that_is_known_precedes_the_track():
    background = texture()
    frames = film(background)
    for frame in frames:
        frame[150:180, 250:290] = (40, 60, 200)
    given = np.tile([270.0, 165.0], (COUNT, 1))
    result = module.video_masks(frames, "a.mp4", np.rint(background).astype(np.uint8), TIMES, given)
    np.testing.assert_allclose([centroid(mask) for mask in result.masks], given, atol=0.3)


def test_exposure_is_found_exactly_and_outside_what_moves():
    background = np.rint(texture()).astype(np.uint8)
    frame = 1.2 * background.astype(float) * (1, 0.9, 0.95) + 4
    frame[ellipse((160, 120), 60, 50)] = 20
    gain, offset = backgrounds.match_exposure(np.rint(frame).astype(np.uint8), background)
    np.testing.assert_allclose(gain, (1.2, 1.08, 1.14), atol=0.01)
    np.testing.assert_allclose(offset, 4, atol=0.8)


def exposure_of_each_pixel(seen, empty):
    """The slow twin of `match_exposure` for one channel: without counts of equal levels."""
    seen, empty = seen.ravel().astype(float), empty.ravel().astype(float)
    valid = (seen > 4) & (seen < 251) & (empty > 4) & (empty < 251)
    seen, empty = seen[valid], empty[valid]
    residual = np.abs(seen - np.median(seen / empty) * empty)
    kept = residual <= np.quantile(residual, 0.6)
    for _ in range(8):
        x, y = empty[kept], seen[kept]
        gain = np.cov(x, y)[0, 1] / x.var(ddof=1) if x.std() > 4 else y.mean() / x.mean()
        offset = y.mean() - gain * x.mean()
        residual = np.abs(seen - gain * empty - offset)
        kept = residual <= max(2.0, 3 * 1.4826 * np.median(residual))
    return gain, offset


@pytest.mark.parametrize("spread", [3, 60], ids=["one brightness", "texture"])
def test_exposure_is_that_of_a_fit_to_each_pixel(spread):
    rng = np.random.default_rng(4)
    background = np.clip(rng.normal(120, spread, (60, 80, 3)), 0, 255).astype(np.uint8)
    frame = background * [1.1, 0.8, 0.95] + [-6, 5, 2] + rng.normal(0, 2, background.shape)
    frame[:25, :40] = (30, 90, 200)
    frame = np.clip(frame, 0, 255).round().astype(np.uint8)
    gains, offsets = backgrounds.match_exposure(frame, background)
    for c in range(3):
        expected = exposure_of_each_pixel(frame[..., c], background[..., c])
        np.testing.assert_allclose((gains[c], offsets[c]), expected, rtol=1e-9, atol=1e-9)


def test_a_weighted_quantile_is_that_of_repeated_values():
    rng = np.random.default_rng(0)
    for size in (1, 2, 7, 40):
        values, counts = rng.normal(size=size), rng.integers(1, 5, size)
        for share in (0, 0.3, 0.5, 0.6, 1):
            expected = np.quantile(np.repeat(values, counts), share)
            assert backgrounds.weighted_quantile(values, counts, share) == pytest.approx(expected, abs=1e-12)


def test_a_shadow_is_distinguished_from_a_dark_object():
    background = texture()
    shaded = np.where(ellipse((80, 120), 40, 40)[..., None], 0.6 * background, background)
    tinted = np.where(ellipse((240, 120), 40, 40)[..., None], background * (0.75, 0.5, 0.4), shaded)
    _, shadow = backgrounds.compare(np.clip(tinted, 0, 255).astype(np.uint8), background.astype(np.float32))
    assert shadow[ellipse((80, 120), 35, 35)].mean() > 0.95
    assert shadow[ellipse((240, 120), 35, 35)].mean() < 0.05


@pytest.mark.parametrize(
    "colour", [(225, 70, 40), (18, 165, 148), (150, 128, 100)], ids=["red", "teal", "stone"]
)
def test_the_dark_shadow_that_it_lands_on_is_left_out(colour):
    """Of a ball in colours that the floor has not and that it has; its colours are unknown."""
    background = stony()
    noisy = background + np.random.default_rng(9).normal(0, 2, background.shape)
    frames, silhouettes = film_of_contact(background, colour)
    result = module.video_masks(frames, "drop.mp4", np.clip(np.rint(noisy), 0, 255).astype(np.uint8), TIMES)
    agreed = [iou(mask, whole) for mask, whole in zip(result.masks, silhouettes)]
    assert min(agreed) > MIN_IOU
    assert np.mean(agreed[: CONTACT - 5]) > 0.98


def test_bad_videos_end_with_what_to_do():
    background = np.rint(texture()).astype(np.uint8)
    frames = film(texture())
    with refused("drop.mp4"):
        module.video_masks([], "drop.mp4", background)
    with pytest.raises(InputError, match="the empty picture is 160x240, the frames 320x240"):
        module.video_masks(frames, "drop.mp4", background[:, ::2])
    moved = [np.roll(frame, 9 * (i % 3), axis=1) for i, frame in enumerate(frames)]
    with pytest.raises(InputError, match=r"drop\.mp4, frame \d+: the background moves"):
        module.video_masks(moved, "drop.mp4", background)
    with pytest.raises(InputError, match=r"drop\.mp4: the mask is empty"):
        module.video_masks([background] * 6, "drop.mp4", background)
