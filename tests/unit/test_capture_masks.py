"""Masks: of a drawn fall with everything that a room adds, of photographs, as given; and what is said of bad input."""

import subprocess

import numpy as np
import pytest
from PIL import Image
from scipy import ndimage

from neuma_lib.errors import InputError

cv2 = pytest.importorskip("cv2")

from neuma_lib.capture import masks as module  # noqa: E402
from neuma_lib.capture import saliency  # noqa: E402
from neuma_lib.capture.frames import Frame  # noqa: E402

WIDTH, HEIGHT = 320, 240
COUNT, CONTACT = 26, 19
TIMES = np.arange(COUNT) / 60
LEAST_IOU = 0.96  # what the masks of the synthetic capture have to reach


def texture(seed=0):
    """A room: smooth patches with fine grain, (H, W, 3)."""
    rng = np.random.default_rng(seed)
    rough = ndimage.gaussian_filter(rng.normal(size=(HEIGHT, WIDTH, 3)), (12, 12, 0))
    fine = ndimage.gaussian_filter(rng.normal(size=(HEIGHT, WIDTH, 3)), (1, 1, 0))
    return np.clip(115 + 700 * rough + 90 * fine, 25, 200)


def places():
    """Of the centre: a fall from rest on to the floor, where it stays."""
    t = np.minimum(TIMES, TIMES[CONTACT])
    return np.stack([120 + 60 * t, 40 + 0.5 * 2700 * t * t], axis=1)


def ellipse(place, rx=17.0, ry=13.0):
    y, x = np.mgrid[:HEIGHT, :WIDTH] + 0.5
    return ((x - place[0]) / rx) ** 2 + ((y - place[1]) / ry) ** 2 <= 1


def film(plate, hand=False, shadow=False, gain=(1.0, 1.0, 1.0), noise=2.0, colour=(225, 70, 40)):
    """Frames (T, H, W, 3), uint8, of a red ball before a plate."""
    rng = np.random.default_rng(3)
    frames = []
    for i, place in enumerate(places()):
        picture = plate.copy()
        if shadow:  # soft, on the floor below the ball
            dark = ellipse((place[0] + 12, 193.0), 26, 7).astype(float)
            picture *= 1 - 0.35 * ndimage.gaussian_filter(dark, 2)[..., None]
        if hand and i < 12:
            reach = 150 - 9 * i
            picture[20:60, :reach] = np.where(ellipse(place)[20:60, :reach, None], 0, (190, 150, 120))
        grey = 0.85 + 0.3 * ndimage.gaussian_filter(rng.normal(size=(HEIGHT, WIDTH)), 3)
        picture = np.where(ellipse(place)[..., None], np.array(colour) * grey[..., None], picture)
        picture = picture * (1 + (np.array(gain) - 1) * i / COUNT) + rng.normal(0, noise, picture.shape)
        frames.append(np.clip(picture, 0, 255).astype(np.uint8))
    return frames


def overlaps(found, frames=range(COUNT)):
    return [module.iou(found.masks[i], ellipse(places()[i])) for i in frames]


def test_a_fall_is_masked_with_shadow_drifting_exposure_and_noise():
    plate = texture()
    frames = film(plate, shadow=True, gain=(1.15, 1.1, 0.95))
    found = module.video_masks(frames, "drop.mp4", np.rint(plate).astype(np.uint8), TIMES)
    assert min(overlaps(found)) > LEAST_IOU
    # 800 pixels with an edge of some 95: half a pixel of random error along it moves the centre by less than 0.1
    np.testing.assert_allclose(found.centroids, places(), atol=0.3)
    # the flight ends within a frame of the contact, after which the parabola would go on
    assert len(found.arcs) == 1 and abs(found.arcs[0].frames[1] - CONTACT) <= 1
    assert found.moving.max() < module.MOST_MOVING
    jumps = module.check_flight(found.masks, "drop.mp4", range(CONTACT))
    assert jumps.max() < 0.06


def test_the_hand_that_lets_go_is_not_the_object():
    plate = texture()
    found = module.video_masks(film(plate, hand=True), "drop.mp4", np.rint(plate).astype(np.uint8), TIMES)
    free = range(13, COUNT)
    assert min(overlaps(found, free)) > LEAST_IOU
    # held, it is either left out, or found without the hand
    assert all(m.sum() < 2 * ellipse(p).sum() for m, p in zip(found.masks, places()))


def test_the_median_of_the_frames_stands_in_for_the_empty_picture():
    frames = film(texture())[: CONTACT + 1]
    found = module.video_masks(frames, "drop.mp4", times=TIMES[: CONTACT + 1])
    # while it is slow, at first, it covers a pixel in too many frames
    assert min(overlaps(found, range(10, CONTACT + 1))) > 0.9


def test_a_place_that_is_known_goes_before_the_arc():
    plate = texture()
    frames = film(plate)
    for frame in frames:
        frame[150:180, 250:290] = (40, 60, 200)
    given = np.tile([270.0, 165.0], (COUNT, 1))
    found = module.video_masks(frames, "a.mp4", np.rint(plate).astype(np.uint8), TIMES, given)
    np.testing.assert_allclose(found.centroids, given, atol=0.3)


def test_exposure_is_found_exactly_and_beside_what_moves():
    plate = np.rint(texture()).astype(np.uint8)
    frame = 1.2 * plate.astype(float) * (1, 0.9, 0.95) + 4
    frame[ellipse((160, 120), 60, 50)] = 20
    gain, offset = module.match_exposure(np.rint(frame).astype(np.uint8), plate)
    np.testing.assert_allclose(gain, (1.2, 1.08, 1.14), atol=0.01)
    np.testing.assert_allclose(offset, 4, atol=0.8)


def test_a_shadow_is_told_from_a_dark_object():
    plate = texture()
    shaded = np.where(ellipse((80, 120), 40, 40)[..., None], 0.6 * plate, plate)
    tinted = np.where(ellipse((240, 120), 40, 40)[..., None], plate * (0.75, 0.5, 0.4), shaded)
    _, shadow = module.compare(np.clip(tinted, 0, 255).astype(np.uint8), plate.astype(np.float32))
    assert shadow[ellipse((80, 120), 35, 35)].mean() > 0.95
    assert shadow[ellipse((240, 120), 35, 35)].mean() < 0.05


def test_bad_videos_end_with_what_to_do():
    plate = np.rint(texture()).astype(np.uint8)
    frames = film(texture())
    with pytest.raises(InputError, match=r"drop\.mp4: there are no frames"):
        module.video_masks([], "drop.mp4", plate)
    with pytest.raises(
        InputError, match="the empty picture is 160x240, the frames 320x240: take it as a frame"
    ):
        module.video_masks(frames, "drop.mp4", plate[:, ::2])
    moved = [np.roll(frame, 9 * (i % 3), axis=1) for i, frame in enumerate(frames)]
    with pytest.raises(InputError, match=r"drop\.mp4, frame \d+: the background moves, .*fix the camera"):
        module.video_masks(moved, "drop.mp4", plate)
    with pytest.raises(InputError, match=r"drop\.mp4: the mask is empty, the object was not found"):
        module.video_masks([plate] * 6, "drop.mp4", plate)


def test_bad_flights_name_the_frame():
    flat = np.stack([ellipse((100 + 3 * i, 100)) for i in range(8)])
    assert module.check_flight(flat, "a.mp4", range(8)).max() < 0.02
    cut = flat.copy()
    cut[4] = ellipse((2, 100))
    with pytest.raises(InputError, match=r"a\.mp4, frame 4: the object leaves the picture"):
        module.check_flight(cut, "a.mp4", range(8))
    cut[4] = False
    with pytest.raises(InputError, match=r"a\.mp4, frame 4: the mask is empty"):
        module.check_flight(cut, "a.mp4", range(8))
    cut[4] = ellipse((112, 100), 30, 20)
    with pytest.raises(InputError, match=r"a\.mp4, frame 4: the mask's area changes by \d+%.*hand"):
        module.check_flight(cut, "a.mp4", range(8))
    module.check_flight(cut, "a.mp4", range(4))  # only the frames that are asked for


def test_a_photograph_is_cut_where_its_colours_change_and_not_where_the_network_guesses():
    rng = np.random.default_rng(0)
    truth = ellipse((160, 120), 60, 45)
    picture = np.where(truth[..., None], (200, 60, 50), texture()) + rng.normal(0, 3, (HEIGHT, WIDTH, 3))
    picture = np.clip(picture, 0, 255).astype(np.uint8)

    def guess(pixels):  # too large, blurred and shifted, as networks are
        return ndimage.gaussian_filter(ellipse((164, 122), 64, 50).astype(float), 4)

    assert module.iou(guess(picture) > 0.5, truth) < 0.9
    assert module.iou(module.photograph_mask(picture, guess, "a.jpg"), truth) > LEAST_IOU
    with pytest.raises(InputError, match=r"a\.jpg: the mask is empty, nothing stands out"):
        module.photograph_mask(picture, lambda pixels: np.zeros(pixels.shape[:2]), "a.jpg")


def test_a_large_photograph_gets_a_mask_of_its_own_size():
    truth = ellipse((160, 120), 60, 45).repeat(5, axis=0).repeat(5, axis=1)
    picture = np.where(truth[..., None], (200, 60, 50), (60, 90, 80)).astype(np.uint8)
    mask = module.photograph_mask(
        picture, lambda p: cv2.resize(truth.astype(np.float32), p.shape[1::-1]), "a.jpg"
    )
    assert mask.shape == truth.shape and module.iou(mask, truth) > LEAST_IOU


def test_own_masks_are_taken_as_they_are(tmp_path):
    mask = ellipse((100, 100))
    grey, clear = tmp_path / "grey.png", tmp_path / "clear.png"
    Image.fromarray(255 * mask.astype(np.uint8)).save(grey)
    Image.fromarray(np.dstack([np.full((HEIGHT, WIDTH, 3), 90, np.uint8), 255 * mask.astype(np.uint8)])).save(
        clear
    )
    np.testing.assert_array_equal(module.read_mask(grey, (WIDTH, HEIGHT)), mask)
    np.testing.assert_array_equal(module.read_mask(clear, (WIDTH, HEIGHT)), mask)
    with pytest.raises(InputError, match=r"grey\.png is 320x240, its picture 64x48"):
        module.read_mask(grey, (64, 48))
    with pytest.raises(InputError, match=r"none\.png"):
        module.read_mask(tmp_path / "none.png", (WIDTH, HEIGHT))
    (tmp_path / "bad.png").write_bytes(grey.read_bytes()[:60])
    with pytest.raises(InputError, match=r"bad\.png"):
        module.read_mask(tmp_path / "bad.png", (WIDTH, HEIGHT))
    Image.new("L", (WIDTH, HEIGHT)).save(tmp_path / "empty.png")
    with pytest.raises(InputError, match=r"empty\.png: the mask is empty"):
        module.read_mask(tmp_path / "empty.png", (WIDTH, HEIGHT))


def test_a_matte_has_the_masks_area_and_none_of_the_floors_colour():
    mask = ellipse((100, 100), 30, 25)
    picture = np.where(ndimage.binary_erosion(mask)[..., None], (200, 60, 50), (0, 0, 255)).astype(np.uint8)
    rgba = module.matted(picture, mask)
    assert rgba.shape == (HEIGHT, WIDTH, 4) and rgba.dtype == np.uint8
    # a blur keeps the sum; rounding to levels adds at most half of one at the pixels of the edge
    assert rgba[..., 3].sum() / 255 == pytest.approx(mask.sum(), rel=2e-3)
    assert (rgba[rgba[..., 3] > 0, :3] == (200, 60, 50)).all()


def test_overlap_and_jumps_have_their_closed_forms():
    a, b = np.zeros((2, 4, 6), bool)
    a[:, :4], b[:, 2:] = True, True
    assert module.iou(a, b) == pytest.approx(8 / 24) and module.iou(~a & a, a & ~a) == 1.0
    np.testing.assert_allclose(module.area_jumps([100, 110, 88]), [0.1, 0.25])
    shown = module.overlay(Frame(3, 0.5, np.full((4, 6, 3), 100, np.uint8)), a)
    assert shown.number == 3 and (shown.pixels[a] == 100).all() and (shown.pixels[:, 4] == (255, 0, 0)).all()


def test_the_network_is_that_of_its_digest(tmp_path, monkeypatch):
    (tmp_path / "u2netp.onnx").write_bytes(b"something else")
    with pytest.raises(InputError, match="damaged or was changed"):
        saliency.fetch_network(tmp_path)

    def fails(*args, **options):
        return subprocess.CompletedProcess(args, 1, "", "no connection\nat all")

    monkeypatch.setattr(subprocess, "run", fails)
    with pytest.raises(InputError, match=r"pip could not fetch .*masks of your own.*no connection"):
        saliency.fetch_network(tmp_path / "other")
    assert not (tmp_path / "other").exists() or not list((tmp_path / "other").iterdir())


def test_a_printed_board_is_hidden_and_what_lies_on_it_is_not():
    rng = np.random.default_rng(0)
    picture = rng.integers(60, 110, (120, 160, 3)).astype(np.uint8)  # the floor
    board = np.array([(40.0, 20.0), (130.0, 25.0), (125.0, 95.0), (35.0, 90.0)])
    rows, columns = np.indices((120, 160))
    printed = (rows > 30) & (rows < 85) & (columns > 45) & (columns < 120)
    tint = np.array([1.0, 0.95, 0.85])  # of the lamp
    picture[printed] = (np.where((rows + columns) // 8 % 2, 250, 20)[printed][:, None] * tint).astype(
        np.uint8
    )
    object_ = (rows - 60) ** 2 + (columns - 110) ** 2 < 15**2  # half of it on the board
    picture[object_] = (220, 60, 40)
    plain = module.without_print(picture, board)
    left = printed & ~object_
    assert ((plain[left] >= 60) & (plain[left] < 110)).all(axis=1).mean() > 0.95
    assert (plain[object_] == (220, 60, 40)).all(axis=1).mean() > 0.95
    outside = (columns < 30) | (rows < 15)
    np.testing.assert_array_equal(plain[outside], picture[outside])
    far = board + 1000.0
    np.testing.assert_array_equal(module.without_print(picture, far), picture)
