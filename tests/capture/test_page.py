"""The page of a capture: what is marked, and what is not."""

import numpy as np

from neuma_lib.capture.frames import Timeline
from neuma_lib.capture.report.page import checks, flight_checks, gravity_checks, markdown

GOOD = {
    "registered": 40,
    "pictures": 40,
    "lost": [],
    "reprojection_error_px": 0.6,
    "unsure": {"left/left.png": [0.2, 0.9, 0.08]},
    "board": {"residual_mm": 0.2, "corners": 35, "pictures": 30},
    "share_of_points_on_floor": None,
}


def video(times):
    return Timeline(np.array(times), 640, 480, 1.0).plain()


def marked(room=(), videos=()):
    """What the page marks of a capture that is good but for some changes."""
    return [check.what for check in checks({**GOOD, **dict(room)}, dict(videos)) if not check.good]


def test_only_what_is_off_is_marked():
    steady = video(np.arange(10) / 120)
    gap = video([0.0, 0.01, 0.02, 0.05, 0.06])
    assert marked(videos={"first, left": steady}) == []
    assert marked({"registered": 38, "lost": ["photographs/a.jpg"] * 2}) == ["pictures with a place"]
    assert marked({"reprojection_error_px": 1.3}) == ["reprojection error"]
    assert marked({"unsure": {"left/left.png": [0.3, 5.0, 0.45]}}) == ["direction of left"]
    assert marked({"board": {**GOOD["board"], "residual_mm": 0.9}}) == ["board's corners off the print"]
    assert marked({"board": None, "share_of_points_on_floor": 0.12}) == ["floor"]
    assert marked(videos={"first, left": steady, "first, right": gap}) == ["frames of first, right"]


def test_poses_from_elsewhere_have_fewer_checks():
    given = {**GOOD, "reprojection_error_px": None, "unsure": {}, "board": None}
    assert [check.what for check in checks(given, {})] == ["pictures with a place"]


def test_page_shows_checks_and_pictures():
    page = markdown(
        "mug", checks({**GOOD, "reprojection_error_px": 2.0}, {}), {"Floor": "floor.png"}, "No videos."
    )
    assert "| reprojection error | 2.00 px | < 1 px | **failed** |" in page
    assert "| pictures with a place | 40 of 40 | all | ok |" in page
    assert "![Floor](floor.png)" in page and "No videos." in page and page.startswith("# mug\n")


def test_checks_of_a_flight_mark_gravity_and_masks():
    report = {
        "gravity_ratio": 1.07,
        "gravity_ratio_deviation": 0.005,
        "gravity_angle_deg": 0.4,
        "gravity_angle_deviation_deg": 0.1,
        "rms_px": 0.3,
        "agreement": {"left": 0.9, "right": 0.5},
    }
    good = {
        check.what: check.good for check in gravity_checks("first", report) + flight_checks("first", report)
    }
    assert good == {
        "gravity in first": False,
        "down in first": True,
        "flight in first": True,
        "mask of left at rest, first": True,
        "mask of right at rest, first": False,
    }
