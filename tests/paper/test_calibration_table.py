"""The table of calibration: it holds for synthetic scenes of known coverage, and does not when a quantile is wrong."""

import csv
import io

import numpy as np
import pytest

from benchmarks.calibration import (
    calibrated,
    cross_validated,
    errors_by_quantity,
    main,
    measured_quantiles,
    report,
)
from neuma_lib.evaluation import calibration
from neuma_lib.evaluation.calibration import GRID, LEVELS, MATERIAL, MOTION
from neuma_lib.fitting.families import FRICTION
from neuma_lib.io.files import write_json
from neuma_lib.paper.calibration_record import constants_with_truths, families_with_truth
from neuma_lib.paper.calibration_table import (
    CALIBRATED,
    FIXED,
    LAPLACE,
    calibration_table,
    coverage,
    reliability,
)
from tests.paper.test_identified_table import HENCKY, LAWS, NEO_HOOKEAN
from tests.support.errors import refused

OTHER = {"elasticity": {"name": "ogden", "E": 1e4, "nu": 0.3, "alpha": 8}}


def synthetic(count: int, seed: int, converged: bool = True) -> list[dict]:
    """Scenes whose errors in estimated standard deviations have Student's t distribution with 1.5 degrees of freedom,
    times 0.35, for constants, and are normal times 3 for motions. The Laplace approximation is ten times too small.

    The probability of the true family is that of its score at a temperature of 0.3.
    """
    generator, scenes = np.random.default_rng(seed), []
    for k in range(count):
        constants = []
        for name in ("E", "G", FRICTION):
            std, truth = generator.uniform(0.02, 0.5), 10 ** generator.uniform(-1, 5)
            value = truth * np.exp(0.35 * std * generator.standard_t(1.5))
            row = {"name": name, "value": value, "truth": truth, "log_std": std, "laplace_log_std": std / 10}
            constants.append(row)
        start = generator.uniform(200, 600, (3, 3))
        value = start + generator.normal(0, 80, (4, 3, 3))
        std = generator.uniform(0.5, 5, value.shape)
        motion = {
            "start_mm": start.tolist(),
            "value_mm": value.tolist(),
            "truth_mm": (value + 3 * std * generator.standard_normal(value.shape)).tolist(),
            "std_mm": std.tolist(),
            "laplace_std_mm": (std / 10).tolist(),
        }
        scores = 0.3 * generator.normal(0, 1.5, 3)
        p = np.exp(-scores / 0.3)
        families = {
            "families": {str(i): {"score": score} for i, score in enumerate(scores.tolist())},
            "compared": ["0", "1", "2"],
            "selected": str(scores.argmin()),
            "right": [str(generator.choice(3, p=p / p.sum()))],
        }
        scenes.append({
            "name": f"random2_{k:03d}", "seed": 2, "development": True, "converged": converged,
            "constants": constants, "families": families if k % 3 else None, "at_least": None,
            "motions": {"launch": motion, "shape": motion}, "failed": {},
        })  # fmt: skip
    return scenes


@pytest.fixture
def use(monkeypatch):
    """A function that stores a calibration, with all quantiles times a factor."""

    def store(content: dict, factor: float = 1.0) -> None:
        quantiles = {name: [factor * q for q in own] for name, own in content["quantiles"].items()}
        monkeypatch.setattr(calibration, "stored", lambda: {**content, "quantiles": quantiles})
        monkeypatch.setattr("neuma_lib.paper.calibration_table.stored", calibration.stored)

    return store


def verdicts(text: str) -> list[str]:
    return [line for line in text.partition("**What holds**")[2].splitlines() if line.count("|") == 4][2:]


def test_intervals_that_were_calibrated_hold_on_other_scenes(use):
    use(calibrated(synthetic(200, 0), {}))
    table, text = calibration_table(synthetic(200, 1), is_development=False, determined=0.1)
    lines = verdicts(text)
    assert len(lines) == 12 and all("**holds**" in line for line in lines), "\n".join(lines)
    rows = {
        (row["quantity"], row["method"], row["level"]): row
        for row in csv.DictReader(io.StringIO(table))
        if row["group"] == "all"
    }
    for quantity in ("constants", "another shape"):
        scores = {m: float(rows[quantity, m, "0.95"]["score"]) for m in (CALIBRATED, LAPLACE, FIXED)}
        assert min(scores, key=scores.get) == CALIBRATED
        assert float(rows[quantity, LAPLACE, "0.95"]["covered"]) < 0.6
    brier = {
        method: float(row["score"]) for (quantity, method, _), row in rows.items() if quantity == "family"
    }
    assert brier[CALIBRATED] < min(brier["selected family"], brier["equal"])
    assert "of the development seeds 2" in text


@pytest.mark.parametrize("factor", [0.6, 1.7])
def test_wrong_quantiles_do_not_hold(use, factor):
    use(calibrated(synthetic(200, 0), {}), factor)
    lines = verdicts(calibration_table(synthetic(200, 1), is_development=False, determined=0.1)[1])
    wrong = [line for line in lines if "**does not hold**" in line]
    assert len(wrong) >= 9 and not any("**holds**" in line for line in lines if "50 %" in line), "\n".join(
        lines
    )


def test_normal_intervals_do_not_hold_for_these_errors(monkeypatch):
    monkeypatch.setattr(calibration, "stored", lambda: {})
    monkeypatch.setattr("neuma_lib.paper.calibration_table.stored", calibration.stored)
    scenes = synthetic(200, 1)
    assert coverage(scenes, "constants", CALIBRATED, 0.5)["covered_low"] > 0.7
    assert coverage(scenes, "another shape", CALIBRATED, 0.95)["covered_high"] < 0.6
    assert "Nothing has been calibrated" in calibration_table(scenes, False, 0.1)[1]


def test_scenes_on_the_same_grid_have_other_quantiles(use):
    """Those of converged truths are not used for them."""
    content = calibrated([*synthetic(100, 0), *synthetic(100, 1, converged=False)], {})
    assert set(content["quantiles"]) == {MATERIAL, GRID, *MOTION.values()}
    content["quantiles"][GRID] = [0.0] * len(LEVELS)
    use(content)
    assert coverage(synthetic(50, 2, converged=False), "constants", CALIBRATED, 0.95)["covered"] == 0
    assert coverage(synthetic(50, 2), "constants", CALIBRATED, 0.95)["covered"] > 0.8


def test_only_development_scenes_calibrate():
    scenes = synthetic(3, 0)
    scenes[1]["development"] = False
    with refused("random2_001"):
        calibrated(scenes, {})


def test_the_calibration_is_what_was_measured():
    scenes = synthetic(60, 0)
    content = calibrated(scenes, {"commit": "abc"})
    z = [
        np.log(row["value"] / row["truth"]) / row["log_std"] for scene in scenes for row in scene["constants"]
    ]
    assert content["quantiles"][MATERIAL] == pytest.approx(measured_quantiles(z).values, rel=1e-3)
    assert content["counts"][MATERIAL] == {"scenes": 60, "values": 180}
    assert content["counts"][MOTION[MATERIAL]]["values"] == 60 * 2 * 36
    assert content["source"]["scenes"][0] == "random2_000" and content["source"]["commit"] == "abc"
    assert 0.15 < content["temperature"] < 0.6
    text = report(scenes, content)
    assert "180 values of 60 scenes" in text and "Brier score" in text


def test_the_command_stores_what_all_intervals_use(tmp_path, monkeypatch, capsys):
    """Only with --write, and only from scenes of development seeds."""
    scenes, stored = synthetic(12, 0), tmp_path / "stored.json"
    for scene in scenes:
        write_json(tmp_path / f"{scene['name']}.json", scene)
    files = sorted(map(str, tmp_path.glob("random2_*.json")))
    for module in ("benchmarks.calibration", "neuma_lib.evaluation.calibration"):
        monkeypatch.setattr(f"{module}.FILE", stored)

    def run(*arguments):
        monkeypatch.setattr("sys.argv", ["calibration", *arguments])
        main()
        return capsys.readouterr().out

    assert "of 12 scenes" in run(*files) and not stored.exists()
    assert str(stored) in run(*files, "--write")
    content = calibration.stored.__wrapped__()
    expected = calibrated(scenes, {})
    assert content["quantiles"] == expected["quantiles"] and content["temperature"] == expected["temperature"]
    assert content["source"]["seeds"] == [2] and len(content["source"]["scenes"]) == 12
    write_json(files[0], scenes[0] | {"development": False})
    stored.unlink()
    with pytest.raises(SystemExit):
        run(*files, "--write")
    assert not stored.exists()


def test_cross_validation_uses_other_scenes():
    """One scene with errors that are far larger than all others is not covered by their quantiles."""
    errors = [np.array([0.1 * k, 0.2]) for k in range(1, 20)] + [np.array([1e3, 1e3])]
    share, *_ = cross_validated(errors)[0.95]
    assert share <= 38 / 40
    assert set(errors_by_quantity(synthetic(4, 0))) == {MATERIAL, MOTION[MATERIAL]}


def test_groups_are_of_family_and_truth(use):
    use(calibrated(synthetic(20, 0), {}))
    table, text = calibration_table([*synthetic(20, 1), *synthetic(20, 2, converged=False)], True, 0.1)
    groups = {row["group"] for row in csv.DictReader(io.StringIO(table))}
    assert groups == {
        "all",
        *(f"{family}, {truth}" for family in ("of a candidate", "outside the candidates")
          for truth in ("converged", "same grid")),
    }  # fmt: skip
    assert "What holds" not in text and "for development" in text
    curves = reliability(synthetic(10, 0))
    assert len(curves["constants"][CALIBRATED]["covered"]) == len(LEVELS)


def test_scenes_without_a_result_are_listed(use):
    use(calibrated(synthetic(20, 0), {}))
    scenes = synthetic(3, 1)
    scenes[0] |= {"motions": {}, "failed": {"launch": "it broke", "shape": "it broke"}, "constants": []}
    scenes[1] |= {"at_least": [0.3, 0.5]}
    scenes[2] |= {"at_least": [0.3, 0.2]}
    text = calibration_table(scenes, True, 0.1)[1]
    assert "Without constants to compare: random2_000" in text
    assert "Without a prediction of another shape: random2_000 (it broke)" in text
    assert "2 scenes, 1 below the truth" in text
    with refused("random.count"):
        calibration_table([], True, 0.1)


def test_determined_constants_are_counted():
    """Only those below the limit, without the friction."""
    scenes = synthetic(2, 0, converged=False)
    cases = [
        ("E", 1.05, 0.02),
        ("G", 1.2, 0.05),
        ("K", 1.08, 0.09),
        ("viscosity", 1.01, 0.2),
        (FRICTION, 1, 0.01),
    ]
    for scene in scenes:
        scene["constants"] = [
            {"name": name, "truth": 2.0, "value": 2 * ratio, "log_std": std, "laplace_log_std": std}
            for name, ratio, std in cases
        ]
    scenes[0]["families"] = None
    scenes[1]["families"] |= {"selected": "0", "right": ["1"]}
    lines = calibration_table(scenes, True, 0.1)[1].splitlines()
    counts = [
        line
        for line in lines
        if line.startswith(("| all | 2 | 0 of 1 |", "| outside the candidates, same grid | 1 |  |"))
    ]
    # of E, G and K of each scene: E and K are within 10 %, K alone within two standard deviations
    assert [line.split("|")[4:7] for line in counts] == [
        [" 6 of 8 ", " 4 ", " 2 "],
        [" 3 of 4 ", " 2 ", " 1 "],
    ]


# ---- records


def identified(**changes) -> dict:
    entry = {"log_std": 0.1, "laplace_log_std": 0.01}
    values = {"E": 1.1e5, "viscosity": 3.0, FRICTION: 0.4}
    quantities = {name: {"value": value, **entry} for name, value in values.items()}
    content = {
        "family": "hencky",
        "compared": ["hencky", "bingham"],
        "families": {name: {"law": law, "score": -5.0} for name, law in LAWS.items()},
        "best": {"quantities": quantities},
        "material": {"quantities": {"E": {"value": 1e5, **entry}}},
    }
    return content | changes


def test_constants_are_compared_with_those_of_the_truth():
    """Those of the material for a converged truth, the friction if it was fitted and has an interval."""
    rows = constants_with_truths(identified(), HENCKY, 0.5, converged=False)
    assert [(row["name"], row["truth"]) for row in rows] == [("E", 1e5), (FRICTION, 0.5)]
    (row,) = constants_with_truths(identified(), HENCKY, 0.5, converged=True)
    assert row == {"name": "E", "truth": 1e5, "value": 1e5, "log_std": 0.1, "laplace_log_std": 0.01}
    sticks = identified(contact_friction={"at_least": 0.3})
    assert [row["name"] for row in constants_with_truths(sticks, HENCKY, 0.5, False)] == ["E"]
    assert constants_with_truths({"best": {}}, HENCKY, None, converged=True) == []


def test_families_are_compared_with_that_of_the_truth():
    known = families_with_truth(identified(), HENCKY)
    assert known["right"] == ["hencky"] and set(known["families"]) == {"hencky", "bingham"}
    assert families_with_truth(identified(), NEO_HOOKEAN)["right"] == [
        "neo_hookean"
    ]  # which was not compared
    assert families_with_truth(identified(), OTHER) is None
