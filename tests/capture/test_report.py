"""The report of a capture: its text, and that it contains all its pictures."""

import re
from html.parser import HTMLParser

import numpy as np
import pytest
from PIL import Image

from neuma_lib.capture.report import warnings as module
from neuma_lib.capture.report.images import COLUMNS
from neuma_lib.capture.report.page import Check, object_checks
from neuma_lib.capture.report.report import Film, number, page, picture_uri, prefixed, room_value
from neuma_lib.evaluation.calibration import interval
from tests.support.errors import refused

NASTY = "<script>alert(\"x\")</script> & 'mug'"
VOID = ("meta", "img", "br")


class Reader(HTMLParser):
    """Checks that elements are closed in order, and keeps what the page refers to."""

    def __init__(self, text):
        super().__init__()
        self.open, self.links, self.tags, self.text = [], [], [], ""
        self.feed(text)
        assert self.open == []

    def handle_starttag(self, tag, attributes):
        self.tags.append(tag)
        self.links += [
            value for key, value in attributes if key in ("src", "href", "poster", "srcset", "data")
        ]
        if tag not in VOID:
            self.open.append(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        self.text += data


def row(method="neuma", take="one", camera="left", learned=True, **values):
    named = {"method": method, "title": method, "throw": take, "camera": camera, "learned": learned}
    return {**named, "frames": 5, **dict.fromkeys(COLUMNS, 0.9), "psnr": 20.0, **values}


def identified(**changes):
    quantities = {
        "E": {"value": 4e5, "log_std": 0.5, "determined": False},
        "yield_stress": {"value": 1000.0, "log_std": 0.05, "determined": True},
        "friction_angle": {"value": 30.0, "log_std": 900.0, "determined": False},
    }
    families = {
        "von_mises": {"held_out_loss": 1e-3, "score": -6.0},
        "hencky": {"held_out_loss": 2e-3, "score": -5.0},
        "sand": {},
    }
    best = {"quantities": quantities, "diverged": False}
    return {"family": "von_mises", "ties": [], "families": families, "best": best, **changes}


@pytest.fixture
def whole(tmp_path):
    """A report with everything in it."""
    Image.new("RGB", (1600, 20), "red").save(tmp_path / "sheet.png")
    (tmp_path / "left.mp4").write_bytes(b"frames")
    return {
        "title": "mug",
        "method": "NeuMA",
        "summary": ["40 photographs."],
        "warnings": ["One camera alone."],
        "checks": {
            "Room": [Check("floor", "12 %", "> 20 %", False), Check("board", "0.2 mm", "< 0.5", True)]
        },
        "pictures": {"Videos": {"Frames: one, left": tmp_path / "sheet.png"}},
        "films": [Film("one", "left", True, tmp_path / "left.mp4", "PSNR 20.0 dB")],
        "rows": [row("nclaw", psnr=15.0), row(), row(take="all", camera="all")],
        "own": "neuma",
        "curves": tmp_path / "sheet.png",
        "identified": identified(),
    }


def test_the_page_holds_all_that_it_shows_and_asks_for_nothing_else(whole):
    read = Reader(page(**whole))
    assert {"video", "img", "table", "details"} <= set(read.tags) and "script" not in read.tags
    assert all(link.startswith(("data:", "#")) for link in read.links) and len(read.links) > 5
    anchors = [link[1:] for link in read.links if link.startswith("#")]
    assert set(anchors) == set(re.findall(r'<h2 id="([^"]+)"', page(**whole)))
    style = page(**whole).partition("<style>")[2].partition("</style>")[0]
    assert "url(" not in style and "@import" not in style
    for text in (
        "40 photographs.",
        "One camera alone.",
        "One check failed.",
        "✗ failed",
        "✓ passed",
        "PSNR 20.0 dB",
    ):
        assert text in read.text
    assert read.text.count("not determined") == 2 and "(training)" in read.text


def test_names_and_texts_are_escaped(whole, tmp_path):
    nasty = {
        "title": NASTY,
        "method": NASTY,
        "summary": [NASTY],
        "warnings": [NASTY],
        "checks": {NASTY: [Check(NASTY, NASTY, NASTY, True)]},
        "pictures": {NASTY: {NASTY: tmp_path / "sheet.png", NASTY + " ": tmp_path / "none.png"}},
        "films": [Film(NASTY, NASTY, True, tmp_path / "left.mp4", NASTY), Film(NASTY, NASTY, True, None)],
        "rows": [row(take=NASTY, camera=NASTY, title=NASTY)],
        "identified": identified(family=NASTY, ties=[NASTY]),
    }
    read = Reader(page(**{**whole, **nasty}))
    assert "script" not in read.tags
    assert read.text.count(NASTY) >= 15
    assert all(link.startswith(("data:", "#")) for link in read.links)


def test_what_is_missing_is_named():
    whole_text = Reader(page("mug", "NeuMA")).text
    for text in (
        "There are no videos.",
        "No pictures were measured.",
        "There are no stress curves.",
        "No family of laws was identified.",
        "There are no checks.",
        "There are no pictures.",
    ):
        assert text in whole_text


def test_files_that_are_not_there_are_named_as_missing(whole, tmp_path):
    gone = tmp_path / "gone"
    films = [Film("one", "left", True, gone)]
    read = Reader(page(**{**whole, "films": films, "pictures": {"Videos": {"Sheet": gone}}, "curves": gone}))
    assert "The video of left is missing." in read.text and "Sheet: the picture is missing." in read.text
    assert "There are no stress curves." in read.text and "video" not in read.tags


def test_a_file_that_is_no_picture_is_named(tmp_path):
    (tmp_path / "sheet.png").write_text("no picture")
    with refused("sheet.png"):
        picture_uri(tmp_path / "sheet.png")


def test_pictures_are_made_small(tmp_path):
    noise = np.random.default_rng(0).integers(0, 255, (300, 3000, 3), np.uint8)
    Image.fromarray(noise).save(tmp_path / "large.png")
    assert len(picture_uri(tmp_path / "large.png")) < (tmp_path / "large.png").stat().st_size / 10


def test_stresses_are_those_of_the_room():
    # A room of half the box's size: the same body is as stiff relative to rho v^2 where E is a quarter.
    assert room_value("E", 4e5, 2.0) == (1e5, "Pa")
    assert room_value("viscosity", 40.0, 2.0) == (10.0, "Pa s")
    assert room_value("friction_angle", 30.0, 2.0) == (30.0, "°")
    assert room_value("yield_strain", 0.1, 2.0) == (0.1, "")
    text = Reader(page("mug", "NeuMA", identified=identified(), scale=2.0)).text
    assert "100 kPa" in text and "250 Pa" in text and "lengths are 2 times" in text
    # An interval, and a constant that is undetermined.
    low, high = interval(250, 0.05, quantity="grid")
    assert f"{number(low)} to {number(high)}" in text
    assert "unknown" in text


def test_a_body_that_sticks_has_a_lower_bound_of_its_friction():
    record = {"contact_friction": {"at_least": 0.75}}
    text = Reader(page("mug", "NeuMA", identified=identified(**record))).text
    assert "contact_friction" in text and "at least 0.75" in text


def test_each_of_several_bodies_has_its_law_and_each_pair_its_friction():
    pairs = [
        {"bodies": ["clay", "gum"], "friction": 0.4, "log_std": 0.1},
        {"bodies": ["gum", "ball"], "friction": 0.5, "log_std": 3.0},
    ]
    bodies = {"clay": identified(), "gum": identified(family="hencky", ties=["von_mises"])}
    several = {"bodies": bodies, "pairs": pairs, "hidden": {"clay": [0.0, 0.25], "gum": [0.0, 0.0]}}
    text = Reader(page("pile", "Constants", identified=several)).text
    assert "clay: identified family: von_mises" in text
    assert "gum: identified family: hencky, tied with von_mises" in text
    assert text.count("Other bodies hide up to") == 2 and "25 %" in text
    low, high = interval(0.4, 0.1, quantity="grid")
    assert f"clay and gum0.4{number(low)} to {number(high)}" in text
    assert "gum and ball0.5unknown" in text
    tie, *open_ = sorted(module.constants_warnings(several), key=lambda line: "equally" not in line)
    assert tie.startswith("gum: The families hencky, von_mises")
    assert [line.partition(":")[0] for line in open_] == ["clay", "gum"]


@pytest.mark.parametrize(
    "value, text",
    [
        (0, "0"),
        (0.25, "0.25"),
        (9996.0, "10000"),
        (1000.0, "1000"),
        (123456.0, "1.23 × 10⁵"),
        (-2e-5, "-2.00 × 10⁻⁵"),
    ],
)
def test_numbers_are_short(value, text):
    assert number(value) == text


def test_stresses_have_prefixes():
    assert prefixed(2.5e5, "Pa") == (1e-3, "kPa") and prefixed(3e6, "Pa s") == (1e-6, "MPa s")
    assert prefixed(250.0, "Pa") == (1.0, "Pa") and prefixed(2.5e5, "°") == (1.0, "°")


DENSITY = {"value": 900.0, "stated": True}
CAPTURE = {"densities": {"": DENSITY}, "held_out": ["two"]}
GOOD_FLIGHT = {"spin_rad_s": [0, 1, 0]}
GOOD_MOTION = {
    "fastest_m_s": 2.0,
    "frames_after_contact": {"left": 30, "right": 30},
    "touched": [],
    "diverged": None,
}


def take(**changes):
    cameras = {"left": 1e-3, "right": 1e-3}
    return {
        "one": {"cameras": cameras, "flights": {"one": GOOD_FLIGHT}, "prediction": GOOD_MOTION, **changes}
    }


def test_a_capture_without_faults_has_no_warnings():
    assert module.filming_warnings(CAPTURE, take()) == []
    assert module.check_warnings({"Room": [Check("floor", "50 %", "> 20 %", True)]}) == []
    rows = [row("nclaw", psnr=15.0), row(), row(take="all", camera="all")]
    assert module.prediction_warnings(rows, "neuma", "nclaw", "constants", {"one": GOOD_MOTION}) == []
    assert module.constants_warnings(None) == []


@pytest.mark.parametrize(
    "changes, message",
    [
        ({"cameras": {"left": 1e-3}}, "only one camera"),
        ({"flights": {"one, gum": {"spin_rad_s": None}}}, "one, gum: no spin was measured"),
        ({"cameras": {"left": 1e-3, "right": 0.0}}, "no exposure is set for right.*2.0 mm"),
        (
            {"flights": {"one": {**GOOD_FLIGHT, "row_delay_s": {"left": 2e-3, "right": 1e-4}}}},
            "no row_time.*at most 4.0 mm for left at",
        ),
        ({"prediction": {**GOOD_MOTION, "frames_after_contact": {"left": 3}}}, "one, left: only 3 frames"),
        ({"prediction": {**GOOD_MOTION, "touched": ["x_min"]}}, "touches the box .x_min."),
        (
            {"registrations": {"one, gum": {"ambiguous": "it looks alike"}, "one, clay": {}}},
            "one, gum: the flight does not determine the pose .*: it looks alike",
        ),
    ],
)
def test_each_fault_of_filming_is_named(changes, message):
    (result,) = module.filming_warnings(CAPTURE, take(**changes))
    assert re.search(message, result)


def test_each_fit_of_gaussians_is_checked():
    fit = {"held_out": ["a"], "count": 900}
    good, bad = object_checks({"": fit | {"psnr_object": 25.0}, "gum": fit | {"psnr_object": 15.0}})
    assert good.good and not bad.good and bad.what.endswith(", gum") and "15.0 dB" in bad.value


def test_what_nobody_stated_or_held_out_is_named():
    for bodies, message in (("", "The density is the default"), ("gum", "The density of gum is the default")):
        densities = {"clay": DENSITY, bodies: {**DENSITY, "stated": False}}
        (density,) = module.filming_warnings({**CAPTURE, "densities": densities}, take())
        assert density.startswith(message) and "900 kg/m³" in density
    (held,) = module.filming_warnings({**CAPTURE, "held_out": []}, take())
    assert "No take is held out" in held


def test_predictions_that_are_worse_than_nothing_are_named():
    rows = [row("nclaw", psnr=21.0), row(iou=0.5)]
    rows += [row(take="all", camera="all"), row(take="all", camera="all", learned=False, psnr=18.0)]
    rows += [row("constants", take="all", camera="all", psnr=22.0)]
    broken = {**GOOD_MOTION, "stable": False, "diverged": {"step": 30, "happened": "became non-finite"}}
    result = module.prediction_warnings(rows, "neuma", "nclaw", "constants", {"one": broken})
    for text in (
        "diverged at step 30",
        "training diverged",
        "prior, without any learning",
        "is 0.50",
        "Held-out",
        "In training frames, the identified constants alone fit better",
    ):
        assert sum(text in line for line in result) == 1, text
    assert len(result) == 6


def test_undetermined_constants_and_ties_are_named():
    tie, open_ = module.constants_warnings(identified(ties=["hencky"]))
    assert (
        "von_mises, hencky" in tie
        and "does not determine E, friction_angle" in open_
        and "yield_stress" in open_
    )


def curve(stress, band=None):
    x = [0.0, 1.0, 2.0, 3.0]
    ends = {"x": x, "low": [v - band for v in x], "high": [v + band for v in x]} if band else None
    return {"stress": stress, "band": ends}


def test_laws_outside_the_band_are_named():
    laws = {
        "nclaw": curve([5.0, 6.0, 7.0, 8.0]),
        "constants": curve([0.0, 1.0, 2.0, 3.0], band=0.5),
        "neuma": curve([0.0, 1.2, 2.2, 3.1]),
    }
    test = {"x": [0.0, 1.0, 2.0, 3.0], "visited": [0.0, 3.0], "by_stress": False, "laws": laws}
    curves = {"learned": "neuma", "rate": 20, "tests": {"shear": test}}
    titles = {"nclaw": "prior", "constants": "identified constants", "neuma": "NeuMA"}
    result = module.curve_warnings(curves, titles, "nclaw", "constants")
    assert len(result) == 3 and "no error bars" in result[1]
    assert result[2].startswith("Shear: over 100 % of the visited range, prior is outside")
    inside = {**test, "laws": {**laws, "nclaw": laws["neuma"]}}
    several = {"bodies": {"clay": curves, "gum": {**curves, "tests": {"shear": inside}}}}
    of_bodies = module.curve_warnings(several, titles, "nclaw", "constants")
    assert of_bodies[:2] == result[:2] and of_bodies[2:] == [f"clay: {result[2]}"]


@pytest.mark.parametrize("bodies", [("",), ("clay", "gum")])
def test_curves_of_several_bodies_have_a_row_each(bodies):
    pytest.importorskip("matplotlib")
    from neuma_lib.evaluation.stress_curves import TESTS, draw

    def own(slope):
        laws = {"constants": curve([slope * v for v in range(4)], band=0.5)}
        test = {"x": [0.0, 1.0, 2.0, 3.0], "visited": [0.0, 3.0], "by_stress": False, "laws": laws}
        return {"learned": "constants", "rate": 20, "tests": dict.fromkeys(TESTS, test)}

    figure = draw({body: own(1000.0 * k) for k, body in enumerate(bodies, 1)}, {"constants": "constants"})
    rows = [figure.axes[k : k + len(TESTS)] for k in range(0, len(figure.axes), len(TESTS))]
    assert [row[0].get_title() for row in rows] == [*bodies]
    for k, row in enumerate(rows, 1):
        assert all(axes.lines[0].get_ydata()[-1] == pytest.approx(3.0 * k) for axes in row)  # kPa
    places = {(round(axes.get_position().x0, 2)) for axes in figure.axes}
    assert len(places) == (len(TESTS) if len(bodies) > 1 else 1)
