"""Gates between the stages of a capture: each number passes for a good body and stops for a bad one."""

import numpy as np
import pytest
from PIL import Image

from neuma_lib.capture import gates
from neuma_lib.capture.pictures import evidence
from neuma_lib.errors import InputError
from tests.support.errors import refused


def body(lowest=0.0, height=0.2):
    rng = np.random.default_rng(0)
    points = rng.uniform(-0.5, 0.5, (4000, 3))
    return points * (0.1, height, 0.1) + (0.5, lowest + height / 2, 0.5)


def test_a_body_stands_on_the_floor():
    gates.check_on_floor(body(), 0.0, "mug")
    gates.check_on_floor(np.concatenate([body(), [[0.5, -0.3, 0.5]]]), 0.0, "mug")  # one stray Gaussian
    with refused("mug", problem="0.169 m below it, 0.020 m are tolerated"):
        gates.check_on_floor(body(-0.171), 0.0, "mug")
    with refused("mug", problem="above it"):
        gates.check_on_floor(body(0.05), 0.0, "mug")


def test_masks_before_their_refinement():
    gates.check_masks([0.9, 0.6, 0.8], "mug")
    with refused("mug", problem="mean IoU with the common visual hull is 0.60", remedy="masks/photographs"):
        gates.check_masks([0.9, 0.3, 0.6], "mug")


def test_photographs_that_were_kept_from_the_fit():
    gates.check_fit(21.0, 15.0, "mug")
    with refused("mug", problem="9.6 dB inside the mask, at least 15 dB"):
        gates.check_fit(9.6, 15.0, "mug")


@pytest.mark.parametrize(
    ("volume", "watertight", "problem"),
    [(1.0, False, "not closed"), (0.5, True, "volume"), (1.4, True, "volume"), (np.nan, True, "volume")],
)
def test_the_surface_is_closed_and_as_large_as_the_visual_hull(volume, watertight, problem):
    gates.check_volume(0.95e-3, 1e-3, True, "mug")
    with refused("mug", problem=problem):
        gates.check_volume(1e-3 * volume, 1e-3, watertight, "mug")


def test_what_a_failed_stage_saw_is_drawn_and_named(tmp_path):
    """Snakemake deletes outputs of failed jobs, so the picture has another name; it goes with the failure."""
    sheet = tmp_path / "sheet.png"
    with refused("mug", remedy="Film again. See") as caught:
        with evidence(sheet, lambda path: gates.draw_body(path, {"Gaussians": body()}, 0.0, "mug")):
            raise InputError("mug", "no object", "Film again")
    failed = tmp_path / "sheet.failed.png"
    assert str(failed) in caught.value.remedy and not sheet.exists()
    with Image.open(failed) as image:
        assert image.width > 500
    with evidence(sheet, lambda path: None):
        pass
    assert not failed.exists()
