"""Table of random scenes of several bodies, and its claims."""

import csv
import io

import pytest

from neuma_lib.errors import InputError
from neuma_lib.paper.claims import RMSE
from neuma_lib.paper.piles_table import COLUMNS, piles_table
from tests.support.sim_scenes import law_spec as law

LAWS = {"cat": law("hencky", "von_mises", E=2e5, yield_stress=1e3), "ball": law("neo_hookean", E=1e5)}


def record(spec, E, ties=()):
    """An identified body, whose families are its own and neo-Hookean."""
    families = {"own": {"law": spec}, "soft": {"law": law("neo_hookean")}}
    quantities = {"E": {"value": E, "log_std": 0.05, "determined": True}}
    return {
        "family": "own", "ties": list(ties), "law": spec, "families": families, "rollouts": 100,
        "best": {"quantities": quantities},
    }  # fmt: skip


def scene(name="random9_00", friction=0.35, log_std=0.1, errors=(3.0, 2.0), rest=1.2, wrong=False):
    fitted = law("fixed_corotated") if wrong else law("hencky")
    bodies = {
        "cat": record(LAWS["cat"], 2.1e5),
        "ball": record(fitted, 1.3e5, ("soft",) if not wrong else ()),
    }
    return {
        "name": name,
        "bodies": LAWS,
        "frictions": [{"bodies": ["ball", "cat"], "friction": 0.3}],
        "identified": [
            {
                "bodies": bodies,
                "pairs": [{"bodies": ["cat", "ball"], "friction": friction, "log_std": log_std}],
                "hidden": {"cat": [0.0, 0.2], "ball": [0.1, 0.6]},
                "rollouts": 60,
            }
        ],
        "metrics": [{"bodies": [{RMSE: value} for value in own]} for own in ((2.0, 2.0), errors)],
        "alone": [bodies["cat"], record(law("stvk"), 1e5)],
        "alone_metrics": [{RMSE: 9.0}, {RMSE: 4.0}],
        "rest": [{RMSE: 2.0}, {RMSE: 2.0 * rest}],
    }


def lines(*scenes, development=False):
    text, page = piles_table(scenes, 9, development)
    header, *rows = csv.reader(io.StringIO(text))
    assert tuple(header) == COLUMNS
    return rows, page


def test_rows_of_bodies_and_pairs():
    (cat, ball, pair), page = lines(scene())
    assert cat[:9] == ["random9_00", "cat", "20.0", "2.0", "3.0", "9.0", "own", "right", "right"]
    assert ball[2] == "60.0" and ball[6:12] == ["own", "tie", "wrong", "1", "0", "E +30 %"]
    assert cat[9:12] == ["1", "1", "E +5 %"]
    assert pair[:2] == ["random9_00", "cat and ball"] and pair[12:14] == ["0.3", "0.35"]
    assert float(pair[14]) == pytest.approx(0.035)
    assert "median 1.25, alone 3.25" in page and "**holds**" in page


def verdicts(page):
    return [line.split(" | ")[1].strip("*") for line in page.splitlines() if " | **" in line]


def test_claims_follow_the_numbers():
    """RMSE in the median and for most, families, constants, frictions, the rest, and the cost."""
    good, bad = "holds", "does not hold"
    assert verdicts(lines(scene())[1]) == [good, good, good, bad, good, good, good]
    _, page = lines(scene(errors=(6.0, 9.0), friction=0.45, rest=1.6, wrong=True))
    assert verdicts(page) == [bad, bad, bad, bad, bad, bad, good]
    # A friction that the contact does not show is not compared, and three pairs of claims need all scenes.
    # A value near 0 with a wide band is not one either.
    for friction, log_std in ((0.45, 0.5), (0.003, 2.9)):
        _, page = lines(scene(friction=friction, log_std=log_std), scene("random9_01"))
        assert "1 of 1" in page and verdicts(page)[4] == good


def test_scenes_for_development_have_no_verdicts():
    _, page = lines(scene(), development=True)
    assert not verdicts(page) and "results are not reported" in page and "bodies: 2 of 2, median 1.25" in page
    with pytest.raises(InputError, match="no random scenes"):
        piles_table([], 9, False)
