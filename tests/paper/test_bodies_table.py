"""Table of the bodies of a scene."""

import csv
import io

from neuma_lib.paper.bodies_table import COLUMNS, bodies_table
from tests.support.sim_scenes import law_spec as law


def record(family, **quantities):
    named = {key: {"value": value, "log_std": 0.1} for key, value in quantities.items()}
    return {"family": family, "best": {"quantities": named}}


def test_rows_of_bodies_and_pairs():
    """A constant that a family has not is empty, and a pair without a friction sticks."""
    truth = {
        "cat": law("hencky", "von_mises", E=2e5, nu=0.3, yield_stress=1e3),
        "ball": law("hencky", E=1e5, nu=0.25),
    }
    identified = {
        "bodies": {"cat": record("plastic", E=1.9e5, yield_stress=950.0), "ball": record("soft", E=1.1e5)},
        "pairs": [{"bodies": ["cat", "ball"], "friction": 0.4, "log_std": 0.2}],
        "hidden": {"cat": [0.0, 0.25, 0.5], "ball": [0.0, 0.0, 0.0]},
    }
    alone = {"cat": record("elastic", E=9e4), "ball": record("soft", E=1.5e5)}
    errors = {"cat": [2.0, 3.0, 9.0], "ball": [1.0, 1.5, 4.0]}
    frictions = [{"bodies": ["ball", "cat"], "friction": 0.5}]
    text, page = bodies_table(identified, alone, truth, frictions, errors)
    header, *rows = csv.reader(io.StringIO(text))
    assert tuple(header) == COLUMNS
    cells = {(row[0], row[1]): row[2:] for row in rows}
    assert cells["cat", "RMSE [mm]"] == ["2.0", "3.0", "", "9.0", ""]
    assert (
        cells["cat", "hidden, mean [%]"][1] == "25.0" and cells["cat", "hidden, last frame [%]"][1] == "50.0"
    )
    assert cells["cat", "family"] == ["hencky+von_mises", "plastic", "", "elastic", ""]
    assert cells["cat", "yield_stress"] == ["1000.0", "950.0", "0.1", "", ""]
    assert cells["ball", "E"] == ["100000.0", "110000.0", "0.1", "150000.0", "0.1"]
    assert cells["cat and ball", "friction"] == ["0.5", "0.4", "0.2", "", ""]
    assert "| cat | RMSE [mm] | 2 | 3 |  | 9 |  |" in page
    sticking, _ = bodies_table(identified, alone, truth, [], errors)
    assert "cat and ball,friction,inf,0.4,0.2,," in sticking
