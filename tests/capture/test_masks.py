"""Masks as given, their mattes and overlaps; and messages for impossible flights."""

import numpy as np
import pytest
from PIL import Image
from scipy import ndimage

from neuma_lib.errors import InputError
from tests.support.drawn_falls import HEIGHT, WIDTH, ellipse

pytest.importorskip("cv2")

from neuma_lib.capture.frames import Frame  # noqa: E402
from neuma_lib.capture.masks import regions as module  # noqa: E402
from tests.support.errors import refused  # noqa: E402


def test_bad_flights_name_the_frame():
    flat = np.stack([ellipse((100 + 3 * i, 100)) for i in range(8)])
    assert module.check_flight(flat, "a.mp4", range(8)).max() < 0.02
    cut = flat.copy()
    cut[4] = ellipse((2, 100))
    with pytest.raises(InputError, match=r"a\.mp4, frame 4: the object leaves"):
        module.check_flight(cut, "a.mp4", range(8))
    cut[4] = False
    with pytest.raises(InputError, match=r"a\.mp4, frame 4: the mask is empty"):
        module.check_flight(cut, "a.mp4", range(8))
    cut[4] = ellipse((112, 100), 30, 20)
    with pytest.raises(InputError, match=r"a\.mp4, frame 4: .*area changes by \d+%"):
        module.check_flight(cut, "a.mp4", range(8))
    module.check_flight(cut, "a.mp4", range(4))  # only the frames that are asked for


def test_own_masks_are_taken_as_they_are(tmp_path):
    mask = ellipse((100, 100))
    grey, clear = tmp_path / "grey.png", tmp_path / "clear.png"
    Image.fromarray(255 * mask.astype(np.uint8)).save(grey)
    Image.fromarray(np.dstack([np.full((HEIGHT, WIDTH, 3), 90, np.uint8), 255 * mask.astype(np.uint8)])).save(
        clear
    )
    np.testing.assert_array_equal(module.read_mask(grey, (WIDTH, HEIGHT)), mask)
    np.testing.assert_array_equal(module.read_mask(clear, (WIDTH, HEIGHT)), mask)
    with pytest.raises(InputError, match=r"grey\.png: .* 320x240, .* 64x48"):
        module.read_mask(grey, (64, 48))
    with refused("none.png"):
        module.read_mask(tmp_path / "none.png", (WIDTH, HEIGHT))
    (tmp_path / "bad.png").write_bytes(grey.read_bytes()[:60])
    with refused("bad.png"):
        module.read_mask(tmp_path / "bad.png", (WIDTH, HEIGHT))
    Image.new("L", (WIDTH, HEIGHT)).save(tmp_path / "empty.png")
    with refused("empty.png", problem="it has no white or opaque pixel", remedy="Draw the object in white"):
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
    drawn = module.overlay(Frame(3, 0.5, np.full((4, 6, 3), 100, np.uint8)), a)
    assert drawn.number == 3 and (drawn.pixels[a] == 100).all() and (drawn.pixels[:, 4] == (255, 0, 0)).all()
