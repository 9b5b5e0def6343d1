"""Identified materials compared with the true ones."""

import csv
import io

import pytest

from neuma_lib.paper.identified_table import (
    RIGHT,
    TIE,
    WRONG,
    compare_family,
    compare_quantities,
    identified_table,
)
from tests.support.errors import refused

HENCKY = {"elasticity": {"name": "hencky", "E": 1e5, "nu": 0.25}, "plasticity": {"name": "identity"}}
NEO_HOOKEAN = {"elasticity": {"name": "neo_hookean", "E": 1e5, "nu": 0.25}}
VISCOUS = {
    "elasticity": {"name": "hencky", "E": 1e5, "nu": 0.25},
    "plasticity": {"name": "viscous_flow", "viscosity": 100.0, "yield_stress": 0.0},
}
BINGHAM = {**VISCOUS, "plasticity": {**VISCOUS["plasticity"], "yield_stress": 50.0}}
DAMPED = {**HENCKY, "viscosity": {"name": "kelvin_voigt", "viscosity": 100.0}}
LAWS = {"hencky": HENCKY, "neo_hookean": NEO_HOOKEAN, "viscous_flow": VISCOUS, "bingham": BINGHAM}


def scene(truth, family, ties=(), group="all", material=False, **quantities):
    """Quantities, to be compared with the truth, as name=(value, standard deviation of the logarithm, determined)."""
    entries = {
        name: {"value": value, "log_std": std, "determined": sure}
        for name, (value, std, sure) in quantities.items()
    }
    results = {
        "family": family,
        "law": LAWS[family],
        "ties": list(ties),
        "families": {name: {"law": law} for name, law in LAWS.items()},
        "best": {"quantities": {} if material else entries},
        **({"material": {"quantities": entries}} if material else {}),
    }
    return {"name": "S", "group": group, "identified": results, "truth": truth}


@pytest.mark.parametrize(
    "truth, family, ties, verdict",
    [
        (HENCKY, "hencky", [], RIGHT),
        (HENCKY, "neo_hookean", [], WRONG),
        (HENCKY, "neo_hookean", ["hencky"], TIE),
        (VISCOUS, "viscous_flow", [], RIGHT),
        (VISCOUS, "bingham", [], WRONG),  # the truth has no yield stress
        (BINGHAM, "viscous_flow", ["bingham"], TIE),
        (DAMPED, "hencky", [], WRONG),
    ],
)
def test_the_family_is_scored_by_its_laws(truth, family, ties, verdict):
    assert compare_family(scene(truth, family, ties)["identified"], truth) == verdict


def test_errors_are_of_quantities_of_the_truth():
    scored = scene(HENCKY, "hencky", E=(1.1e5, 0.05, True), G=(3.6e4, 0.1, False), viscosity=(3.0, 0.1, True))
    young, shear = compare_quantities(scored["identified"], HENCKY)  # the truth has no viscosity
    assert young["error_percent"] == pytest.approx(10)
    assert young["error_in_std"] == pytest.approx(1.906, abs=1e-3)
    assert shear["truth"] == pytest.approx(4e4) and shear["error_percent"] == pytest.approx(-10)
    table, text = identified_table([scored])
    rows = list(csv.DictReader(io.StringIO(table)))
    assert [row["quantity"] for row in rows] == ["E", "G"]
    assert float(rows[0]["error_percent"]) == pytest.approx(10, rel=1e-3)
    assert "E +10 % (+1.9)" in text and "G -10 % (-1.1)" in text


@pytest.mark.parametrize("close, word", [(4, "holds"), (3, "does not hold")])
@pytest.mark.parametrize("material", [False, True])
def test_claims_need_four_of_five(close, word, material):
    """Of the constants of the material if there are any, else of those on the grid."""
    values = [1e5] * close + [1.3e5] * (5 - close)
    scenes = [scene(HENCKY, "hencky", material=material, E=(value, 0.05, True)) for value in values]
    verdicts = identified_table(scenes)[1].partition("**What holds**")[2]
    families, coverage, error = [line for line in verdicts.splitlines() if line.startswith("| all")]
    assert "**holds**" in families and "5 of 5" in families
    assert f"**{word}**" in coverage and f"{close} of 5" in coverage
    assert f"**{word}**" in error


def test_nothing_identified_is_an_error():
    with refused("tables.table1"):
        identified_table([])
