"""A method and a law in files of the user, from the settings to a row of a table (own_method.py, own_law.py)."""

import csv
import json

import pytest

from tests.support.full_run import CUBIC, METHODS, OWN_TABLE, SETTINGS, TARGETS
from tests.support.project import SCENE, TABLE

REPEATED = {"fit_brightness": 2, "evaluate": 2, "chamfer_table": 1}


def test_a_method_in_a_file_gets_a_row_of_a_table(full):
    assert full.ran.behind(OWN_TABLE) == REPEATED
    moduli = [
        json.loads((full.root / SCENE / name / "modulus.json").read_text())["E"] for name in METHODS[1:]
    ]
    assert moduli[0] == pytest.approx(2 * moduli[1]) and f"E = {moduli[0]:.4g} Pa" in full.output
    rows = list(csv.reader((full.root / OWN_TABLE).read_text().splitlines()))
    errors = {row[1]: float(row[3]) for row in rows if row[0] == "tracer_rmse_mm"}
    assert [*errors] == METHODS
    assert errors["brightness"] != errors["brightness+scale=100000"]
    page = (full.root / OWN_TABLE).with_suffix(".md").read_text()
    assert "Brightness, scale 100000" in page and "One number." in page


def test_a_law_in_a_file_is_that_of_a_scene(full):
    assert full.ran.behind(CUBIC) == {"ground_truth": 1} and "ground_truth Cubic: " in full.output


@pytest.mark.parametrize(
    ("file", "old", "new", "table", "others"),
    [
        ("own_method.py", "of no use", "useless", {}, {}),
        (
            "own_method.py",
            "/ 255",
            "/ 256",
            REPEATED,
            {"viewer": 1, "demo": 1},
        ),  # the viewer may load any method
        ("own_law.py", "b * eps**2", "b * eps**4", REPEATED, {"ground_truth": 1}),
    ],
)
def test_edits_of_the_files_repeat_what_depends_on_them(full, file, old, new, table, others):
    """And nothing else of all that has been made; without an edit that counts, nothing at all."""
    path = full.root / file
    text = path.read_text()
    path.write_text(text.replace(old, new))
    try:
        plan = full.plan(*SETTINGS, TABLE, *TARGETS)
    finally:
        path.write_text(text)
    assert plan.behind(OWN_TABLE) == table and plan == table | others
    assert plan.behind(CUBIC)["ground_truth"] == others.get("ground_truth", 0)
