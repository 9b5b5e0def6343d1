"""Tables of errors: their numbers, notes, and verdicts on the paper's claims."""

import csv
import io
from pathlib import Path

import numpy as np
import pytest
import yaml

from neuma_lib.errors import InputError
from neuma_lib.paper.claims import Claim, Closer, shown
from neuma_lib.paper.published import PAPER, PaperTable
from neuma_lib.paper.tables import chamfer_table
from neuma_lib.project.loading import load
from tests.support.errors import refused
from tests.support.table_results import run

ROOT = Path(__file__).resolve().parents[2]


BROKEN = {
    "diverged": {"happened": "moved by more than a cell in a step", "step": 80, "particle": 7},
    "energy_gain_after_step": 60,
}
TITLES = {"nclaw": "NCLaw", "neuma": "NeuMA"}
SCENES = {scene: scene for scene in PAPER["table1"].columns}
AB = {"a": "a", "b": "b"}


def rows_of(table) -> dict:
    return {(row["quantity"], row["method"]): row for row in csv.DictReader(io.StringIO(table.csv()))}


def test_no_law_is_closer_than_the_true_one():
    metrics = {
        "nclaw": {"a": [run(9.0)], "b": [run(1.0, **BROKEN)]},
        "true_law": dict.fromkeys("ab", [run(4.0)]),
    }
    table = chamfer_table(metrics, {"nclaw": "NCLaw", "true_law": "True law"}, AB)
    assert "None is closer than it." in table.absorbed()
    assert chamfer_table(metrics, {"nclaw": "NCLaw"}, AB).absorbed() is None


def test_a_method_that_knows_the_truth_wins_nothing():
    metrics = {m: {"a": [run(value)]} for m, value in (("neuma", 2.0), ("true_law", 1.0), ("nclaw", 3.0))}
    table = chamfer_table(metrics, {**TITLES, "true_law": "True law"}, {"a": "a"})
    assert table.wins() == {"nclaw": 0, "neuma": 1}
    assert "| True law | 1.0 | 1.0 | 2.0 | 3.0 |  |" in table.markdown()


def test_numbers_that_round_to_zero_are_below_the_last_digit():
    assert [shown(x, 2) for x in (0.0, 0.004, 0.0051, -0.001, 1.0)] == [
        "< 0.01",
        "< 0.01",
        "0.01",
        "< 0.01",
        "1.00",
    ]
    assert shown(0.04, 1) == "< 0.1"


def test_averages_equal_those_printed_in_the_paper():
    printed = {
        "table1": {"pac_nerf": 114.80, "nclaw": 12.18, "neuma": 1.31, "neuma_particle_supervision": 1.51,
                   "neuma_without_binding_own": 6.60, "neuma_without_adaptor": 1.79},
        "table5": {"neuma+rank=4": 1.18, "neuma+rank=8": 1.10, "neuma": 1.04, "neuma+rank=24": 1.05},
    }  # fmt: skip
    for table, averages in printed.items():
        assert set(averages) == set(PAPER[table].rows)
        for method, average in averages.items():
            assert np.mean(PAPER[table].rows[method]) == pytest.approx(average, abs=7e-3), method


def test_tables_of_the_paper_are_complete():
    settings = load(yaml.safe_load((ROOT / "config" / "config.yaml").read_text()), ROOT)
    for name, paper in PAPER.items():
        table = settings.tables[name]
        assert tuple(paper.columns) == (*table.scenes, *table.experiments)
        assert set(paper.rows) - {"pac_nerf"} <= set(table.methods)
        for claim in paper.claims:
            assert claim.methods <= set(table.methods) and set(claim.columns) <= set(paper.columns)
        assert all(len(row) == len(paper.columns) for row in paper.rows.values())


def test_diverged_runs_are_listed_in_the_csv():
    metrics = {
        "nclaw": {"BouncyBall": [run(5.0)], "Other": [run(4.0, **BROKEN)]},
        "neuma": {"BouncyBall": [run(1.0, stable=False)], "Other": [run(2.0)]},
    }
    table = chamfer_table(metrics, TITLES, {"BouncyBall": "Ball", "Other": "Other"}, PAPER["table1"])
    assert "*paper*" not in table.markdown(), "the paper has no such column"
    rows = rows_of(table)
    assert rows["chamfer", "nclaw"]["diverged"] == "Other"
    assert rows["chamfer", "neuma"]["diverged"] == "BouncyBall"


@pytest.mark.parametrize(
    ("failing", "word"), [({}, "holds"), ({"letter_N_jelly_fast": BROKEN}, "does not hold")]
)
def test_claim_that_no_letter_breaks_off_counts_all_letters(failing, word):
    columns = dict.fromkeys(PAPER["letters"].columns, "")
    metrics = {"neuma_structured": {c: [run(2.0), run(2.1), run(2.2, **failing.get(c, {}))] for c in columns}}
    table = chamfer_table(metrics, {"neuma_structured": "ours"}, columns, PAPER["letters"])
    near, sound = table.verdicts()
    assert near.word == "holds", "a letter at 3 m/s is no matter of those at 1 m/s"
    assert sound.word == word and f"kept in {12 - len(failing)} of 12" in sound.here
    assert "broke_off" not in table.csv()


def test_a_missing_or_broken_cell_is_named():
    column = {"BouncyBall": "BouncyBall"}
    with pytest.raises(InputError, match="metrics.json of neuma on BouncyBall"):
        chamfer_table({"nclaw": {"BouncyBall": [run(1.0)]}}, TITLES, column)
    broken = {"nclaw": {"BouncyBall": [run(float("nan"))]}}
    with refused("BouncyBall/nclaw/metrics.json"):
        chamfer_table(broken, {"nclaw": "NCLaw"}, column)


def test_only_replicates_above_twice_the_mean_of_their_cell_are_named():
    metrics = {
        "nclaw": {"a": [run(5.0)] * 3, "b": [run(1.0), run(1.0), run(3.0)]},
        "neuma": {"a": [run(1.0), run(9.0), run(1.0)], "b": [run(2.0)] * 3},
    }
    table = chamfer_table(metrics, TITLES, {"a": "A", "b": "b"})
    assert table.outliers() == [
        "NeuMA on A, replicate 2 of 3: 9.0 mm, more than twice the mean of its replicates."
    ]


# ---- verdicts

METHODS = {**TITLES, "other": "Other"}


def verdict_on(claim: Claim, errors: dict, paper: dict | None = None, columns=AB, diverged=(), **broken):
    """Verdict on a claim; `errors`: method -> one list of replicates a column, broken: method -> what its runs add,
    diverged: (method, column) of trainings."""
    printed = PaperTable("tab:x", "X", "x", tuple(columns), paper or {}, (claim,))
    metrics = {
        method: {
            column: [
                run(value, stable=(method, column) not in diverged, **broken.get(method, {}))
                for value in replicates
            ]
            for column, replicates in zip(columns, values, strict=True)
        }
        for method, values in errors.items()
    }
    titles = {method: METHODS[method] for method in errors}
    (verdict,) = chamfer_table(metrics, titles, columns, printed).verdicts()
    return verdict


CLOSER = Closer("NeuMA is closer", ("neuma",), ("nclaw",))


def test_a_claim_holds_on_average_in_most_columns_and_beyond_the_spread():
    far = {"nclaw": [[5, 6, 7], [5, 6, 7]], "neuma": [[1, 2, 3], [1, 2, 3]]}
    verdict = verdict_on(CLOSER, far, {"neuma": (1.0, 2.0), "nclaw": (3.0, 3.0)})
    assert verdict.word == "holds" and verdict.paper == "1.50 against 3.00"
    assert verdict.here == "2.0 ± 1.0 (NeuMA) against 6.0 ± 1.0 (NCLaw), lower in 2 of 2"
    assert str(verdict) == f"Holds: NeuMA is closer. {verdict.here}."
    # The intervals 2 to 4 and 4 to 6 touch.
    near = verdict_on(CLOSER, far | {"nclaw": [[4, 5, 6], [2, 3, 4]]})
    assert near.word == "mixed" and near.here.endswith("lower in 2 of 2; the ± overlap") and near.paper == ""


def test_a_claim_with_too_few_runs_is_mixed_at_most():
    for replicates in (1, 2):
        verdict = verdict_on(CLOSER, {"nclaw": [[9] * replicates] * 2, "neuma": [[1] * replicates] * 2})
        assert verdict.word == "mixed" and f"; {replicates} run" in verdict.here
    assert verdict_on(CLOSER, {"nclaw": [[1], [1]], "neuma": [[9], [9]]}).word == "does not hold"


def test_a_claim_needs_average_and_majority():
    outlier = {"nclaw": [[9, 9, 9], [1, 1, 1]], "neuma": [[2, 2, 2], [2, 2, 2]]}
    verdict = verdict_on(CLOSER, outlier)
    assert verdict.word == "mixed" and verdict.here.endswith("lower in 1 of 2; not in most columns")
    columns = {**AB, "c": "c"}
    verdict = verdict_on(
        CLOSER, {"nclaw": [[2] * 3] * 3, "neuma": [[1] * 3, [1] * 3, [9] * 3]}, columns=columns
    )
    assert verdict.word == "mixed" and verdict.here.endswith("lower in 2 of 3; not on average")
    verdict = verdict_on(CLOSER, {"nclaw": [[1] * 3] * 2, "neuma": [[1] * 3] * 2})
    assert verdict.word == "does not hold", "equal is not lower"


def test_a_claim_about_groups_is_one_about_all_their_pairs():
    """The worst of the first against the best of the others, in every column and with every spread."""
    claim = Closer("they are closest", ("neuma", "other"), ("nclaw",), ("b",), by_paper=False)
    errors = {"neuma": [[1] * 3, [1] * 3], "other": [[9] * 3, [2, 3, 4]], "nclaw": [[1] * 3, [6] * 3]}
    verdict = verdict_on(claim, errors)
    assert verdict.word == "holds" and verdict.here.startswith(
        "3.0 ± 1.0 (Other) against 6.0 ± < 0.1 (NCLaw)"
    )
    assert verdict.here.endswith("lower in 1 of 1") and verdict.paper == "not compared there"
    # The lower average has the wider spread.
    assert verdict_on(claim, errors | {"neuma": [[1] * 3, [-8, 1, 10]]}).word == "mixed"


def test_a_prediction_that_stops_early_cannot_support_a_claim():
    errors = {"nclaw": [[9, 9, 9]] * 2, "neuma": [[1, 1, 1]] * 2}
    verdict = verdict_on(CLOSER, errors, neuma=BROKEN)
    assert verdict.word == "mixed" and verdict.here.endswith("; a prediction broke off")
    assert verdict_on(CLOSER, errors, nclaw=BROKEN).word == "holds", "its error is even larger"


def test_a_claim_does_not_depend_on_a_training_that_diverged():
    """NCLaw's spread in column b is that of its average without column c."""
    errors = {"nclaw": [[9] * 3, [1, 5, 9], [90] * 3], "neuma": [[8] * 3, [3] * 3, [1] * 3]}
    columns = {**AB, "c": "c"}

    def verdict(*diverged):
        return verdict_on(CLOSER, errors, columns=columns, diverged=diverged)

    assert verdict().word == verdict(("nclaw", "b")).word == "holds"
    alone = verdict(("nclaw", "c"))
    assert alone.word == "mixed"
    assert alone.here.endswith("lower in 3 of 3; not without the columns in which a training diverged")
    assert verdict(("neuma", "c")).word == "holds", "the error of its training counts"
    assert verdict(*(("nclaw", column) for column in columns)).word == "mixed"


def test_claims_without_rows_have_no_verdict():
    claims = (CLOSER, Closer("nobody runs this", ("neuma",), ("pac_nerf",)))
    paper = PaperTable("tab:x", "X", "x", claims=claims)
    metrics = {method: {c: [run(value)] for c in AB} for method, value in (("nclaw", 1.0), ("neuma", 2.0))}
    text = chamfer_table(metrics, TITLES, AB, paper).markdown()
    assert (
        "| NeuMA is closer | **does not hold** | 2.0 (NeuMA) against 1.0 (NCLaw), lower in 0 of 2 |  |"
        in text
    )
    assert "nobody runs this" not in text
