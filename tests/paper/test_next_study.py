"""Study of chosen experiments: numbers of its page from given results, and a tiny run of its tasks."""

import math

import pytest
import yaml

from benchmarks import next_experiment as study
from benchmarks.next_experiment import Material, Task, drawn, main, page
from neuma_lib.io.files import read_json

TINY = {
    "random": {"seed": 1, "count": 1},
    "next": {"kinds": ["launch", "press", "hang"]},
    "simulation": {"grid": 12},
    "geometry": {"particles": 200},
    "dataset": {"particles": 400, "frames": 9, "dynamic": {"width": 24, "height": 24}},
    "advanced": {"next.candidates": 3, "identify.pyramid": [8, 24], "identify.determined": 0.01},
}


@pytest.fixture(scope="module")
def materials():
    return drawn(["config/studies/next_experiment.yaml"], 3)


def fit(rank, kind, std, predicted, error=0.1):
    return {
        "rank": rank,
        "kind": kind,
        "family": "hencky",
        "std": {"G": std, "K": 4 * std},
        "predicted": {"G": predicted, "K": 4 * predicted},
        "error": {"G": error, "K": -error},
    }


def test_the_page_has_the_measures_of_the_issue(materials):
    """One material: the choice leaves a half of the mean random launch, and twice the best in hindsight."""
    name, settings = next((n, own) for n, own in materials.items() if own.random.family(n) == "hencky")
    chosen = fit(0, "press", 0.1, 0.05)
    launches = [fit(1, "launch", 0.2, 0.2, 0.2), fit(2, "launch", 0.2, 0.2, 0.2)]
    best = fit(3, "hang", 0.05, 0.1, 0.3)
    fits = [chosen, *launches, best]
    ranking = {"alone": {"std": {"G": 0.4, "K": 1.6}}, "options": [{"kind": each["kind"]} for each in fits]}
    known = {"family": "hencky", "ties": [], "std": {"G": 0.05, "K": 0.09}}
    unsure = known | {"std": {"G": 0.05, "K": 0.5}}
    results = {Task(name, "fit", k): own for k, own in enumerate(fits)} | {Task(name, "ranking", 0): ranking}
    results[Task(name, "loop", 1)] = {"rounds": [unsure, known]}
    results[Task(name, "loop", 0)] = {"rounds": [unsure] * study.EXPERIMENTS}
    text = page([Material.of(name, settings, results)], "command")
    for row in (
        "std, chosen experiment over random launches | 0.6 | 0.50 [0.50, 0.50] | 1",
        "std, chosen launch over random launches | 0.6 | 1.00 [1.00, 1.00] | 1",
        "std, chosen experiment over the best in hindsight | 1.1 | 2.00 [2.00, 2.00] | 1",
        "errors, chosen experiment over random launches |  | 0.50 [0.50, 0.50] | 1",
        "errors, chosen launch over random launches |  | 1.00 [1.00, 1.00] | 1",
        "experiments, median of chosen ones | half of random | 2 | 1",
        f"experiments, median of random launches |  | {study.EXPERIMENTS + 1} | 1",
        "predicted over reported std, median | 1 | 1.00 | 1, 4 fits",
        "errors in the predicted 95 % interval | 0.92 to 0.98 | 1.00 | 1, 8 constants",
        "errors of the chosen in the predicted 50 % interval | 0.45 to 0.55 | 0.50 | 1, 2 constants",
        "families distinguished after two experiments | 22 of 24 | 1 of 1 | 1",
    ):
        assert f"| {row} |" in text, text
    assert f"| {name} | press | 80 % | 10 % | 20 % | 40 % | 10 % | 2 | {study.EXPERIMENTS + 1} |" in text
    del results[Task(name, "fit", 3)]
    assert "hindsight |" not in page([Material.of(name, settings, results)], "command")
    refused = Material.of(name, settings, {Task(name, "ranking", 0): {"refused": "no launch"}})
    assert "no launch" in page([refused], "command") and math.isfinite(len(refused.fits))


def test_materials_outside_the_families_are_the_last_ones(materials):
    families = [settings.random.family(name) for name, settings in materials.items()]
    (settings, *_) = materials.values()
    assert [family in settings.identify.families for family in families] == [True] * 21 + [False] * 3
    assert set(families) >= set(settings.random.families)


def test_a_tiny_study_runs_and_continues(tmp_path, monkeypatch, capsys):

    monkeypatch.setattr(study, "EXPERIMENTS", 2)

    def with_few_families(files, outside):
        materials = drawn(files, outside)
        for name, own in materials.items():
            families = {key: own.identify.families[key] for key in ("hencky", "neo_hookean")}
            identify = own.identify.model_copy(update={"families": families})
            materials[name] = own.model_copy(update={"identify": identify})
        return materials

    monkeypatch.setattr(study, "drawn", with_few_families)
    overlay, out, text = tmp_path / "tiny.yaml", tmp_path / "out.json", tmp_path / "page.md"
    overlay.write_text(yaml.safe_dump(TINY))
    command = [str(overlay), "--outside", "0", "--out", str(out), "--page", str(text)]
    main(command)
    results = read_json(out)
    assert len(results) == 6 and not any("refused" in result for result in results.values())
    assert "Task(" in capsys.readouterr().out
    fits = [result for result in results.values() if "rank" in result]
    assert {each["kind"] for each in fits} == {"launch", "press", "hang"}
    assert "| std, chosen experiment over random launches | 0.6 | " in text.read_text()
    main(command)
    assert "Task(" not in capsys.readouterr().out
