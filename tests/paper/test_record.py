"""Recording updates numbers of pages from tables and figures, and nothing else."""

from __future__ import annotations

import sys

import numpy as np
import pytest

from docs import record
from neuma_lib.io.files import write_json
from neuma_lib.paper.image_grid import ImageGrid, save_image_grid
from neuma_lib.paper.published import PAPER
from neuma_lib.paper.random_scenes import random_table
from neuma_lib.paper.tables import chamfer_table
from tests.support.random_results import METHODS, result
from tests.support.table_results import run

PAGE = "# Title\n\nBefore.\n\n<!-- {0} -->\nold\n<!-- /{0} -->\n\nAfter.\n"


@pytest.fixture
def project(tmp_path):
    """A run with a table 1 of two methods in three replicates, and data of three figures."""
    scenes = {scene: scene for scene in PAPER["table1"].columns}
    metrics = {
        method: {scene: [run(error + k) for k in range(3)] for scene in scenes}
        for method, error in (("nclaw", 50), ("neuma", 5))
    }
    titles = {method: METHODS[method] for method in metrics}
    table = chamfer_table(metrics, titles, scenes, PAPER["table1"])
    figures = tmp_path / "results/figures"
    figures.mkdir(parents=True)
    (tmp_path / "results/table1.md").write_text(table.markdown())
    (tmp_path / "results/table1.csv").write_text(table.csv())
    cells = {"neuma": {"A": 0.25, "B": 0.75}}
    quality = dict.fromkeys(record.image_quality.MEASURES, cells)
    write_json(figures / "image_quality.json", {"titles": {"neuma": "NeuMA"}, "seen": ["B"], **quality})
    norms = {"elastic": [1.0, 3.0, 2.0], "plastic": [0.5]}
    change = {"elastic": 0.068, "plastic": 0.011}
    write_json(
        figures / "gradient_analysis.json", {"A": {"norms": norms, "change": change, "wrong": "elastic"}}
    )
    laws = {"constants": {"band": {"inside": 0.5}}, "neuma": {"band": None}}
    tests = {"uniaxial": {"laws": laws}, "shear": {"laws": {"constants": {"band": {"inside": 1.0}}}}}
    write_json(
        figures / "material_response.json", {"titles": {"constants": "Constants"}, "scenes": {"A": tests}}
    )
    heights = [[1.0, 0.9, 0.5], [1.0, 0.9, 0.6], [1.0, 0.9, 0.4], [1.0, 0.0, 0.0]]
    grid = ImageGrid(
        np.zeros((1, 1, 2, 2, 3), np.uint8),
        ("",),
        ("",),
        {"weights": [0, 0.5, 1, 2], "scenes": {"A": {"heights": heights}}},
    )
    save_image_grid(figures / "lora_alphav.h5", grid)
    (tmp_path / "docs").mkdir()
    (tmp_path / "README.md").write_text(PAGE.format("table1"))
    (tmp_path / "docs/claims.md").write_text(PAGE.format("verdicts"))
    (tmp_path / "docs/figures.md").write_text(PAGE.format("figures"))
    return tmp_path


def recorded(project, monkeypatch, *options) -> tuple[str, str]:
    """The README, and the pages of claims and figures, after a recording."""
    where = ["--results", "results", "--out", "docs", "--readme", "README.md", "--machine", "a machine"]
    monkeypatch.chdir(project)
    monkeypatch.setattr(sys, "argv", ["record", *where, "--commit", "abc", *options])
    record.main()
    return (project / "README.md").read_text(), "".join(
        (project / "docs" / page).read_text() for page in ("claims.md", "figures.md")
    )


def test_pages_are_updated_from_tables_and_figures(project, monkeypatch):
    readme, page = recorded(project, monkeypatch)
    assert readme.startswith("# Title\n\nBefore.\n") and readme.endswith("<!-- /table1 -->\n\nAfter.\n")
    assert "\nold\n" not in readme and "commit abc: [all columns" in readme and "*paper*" not in readme
    assert "| NeuMA | 6.0 | 6.0 | 6.0 | 6.0 | 6.0 | 6.0 | 6.0 ± 1.0 |" in readme and "Median" not in readme
    expected = (
        "| [table1](table1.md) | NeuMA is closer than its prior | **holds** | 6.0 ± 1.0 (NeuMA) against 51.0 ± 1.0"
        " (NCLaw), lower in 6 of 6 | 1.31 against 12.18 |\n\nNot recorded: table2"
    )
    assert expected in page, "other claims are about methods that were not run"
    assert "Made by `snakemake tables figures` and `python" in (project / "docs/table1.md").read_text()
    assert "| NeuMA | 0.5 | 0.5 | 0.5 | 0.5 |" in page and "Training saw the views of B." in page
    assert "| A | elastic | 2 | 0.5 | 6.8 % | 1.1 % |" in page
    assert "| Method | A |\n|---|---:|\n| Constants | 75 % |" in page
    # Heights part in the last frame only, and there 0.6 is no step from 0.5 to 0.4.
    assert "0 of 1 (A)" in page
    assert recorded(project, monkeypatch) == (readme, page)


def test_random_scenes_and_table1_convergeds_have_their_verdicts(project, monkeypatch):
    columns = {scene: scene for scene in PAPER["table1_converged"].columns}
    errors = {"nclaw": 50.0, "neuma": 5.0, "true_law": 8.0}
    metrics = {
        method: {c: [run(error + k) for k in range(3)] for c in columns} for method, error in errors.items()
    }
    table = chamfer_table(metrics, METHODS, columns, PAPER["table1_converged"])
    scenes = [result(str(k), 8.0, 2.0 if k else 9.0) for k in range(12)]
    csv, markdown, _ = random_table(scenes, METHODS, 7)
    for name, text, values in (
        ("table1_converged", table.markdown(), table.csv()),
        ("random", markdown, csv),
    ):
        (project / f"results/{name}.md").write_text(text)
        (project / f"results/{name}.csv").write_text(values)
    _, page = recorded(project, monkeypatch)
    assert (
        "| [table1_converged](table1_converged.md) | with converged truths, NeuMA is closer than its prior | **holds** "
        "| 6.0 ± 1.0"
        " (NeuMA) against 51.0 ± 1.0 (NCLaw), lower in 6 of 6 | not compared there |\n| [random](random.md) |"
    ) in page
    assert (
        "| [random](random.md) | NeuMA is closer than its prior on at least 11 of 12 random scenes | **holds** |"
        " 11 of 12, errors 0.25 to 1.12 times as large | not compared there |"
    ) in page
    assert page.count("| [random](random.md) |") == 4
    closer = page[page.index("\n\n[table1_converged](table1_converged.md): The true law") :]
    assert "than it: NeuMA in 6 of 6 columns (there by 3.0 of 9.0 mm on average)" in closer
    assert "Made by `snakemake random` and" in (project / "docs/random.md").read_text()


def test_settings_of_the_run_are_named(project, monkeypatch):
    recorded(project, monkeypatch, "--configfile", "config/studies/three_chains.yaml")
    table = (project / "docs/table1.md").read_text()
    assert "default settings (`config/config.yaml`) with `config/studies/three_chains.yaml`. Made by" in table
    assert "`snakemake --configfile config/studies/three_chains.yaml -- tables figures` and" in table


def test_tables_that_are_not_recorded_are_named(project, monkeypatch):
    _, page = recorded(project, monkeypatch)
    missing = page[page.index("Not recorded: ") :].partition(".\n")[0]
    assert (
        "table1_converged (`snakemake results/table1_converged.csv`), random (`snakemake random`)" in missing
    )
    assert "table1 (" not in missing and "table1_converged](" not in page and "random](" not in page
    whole = dict.fromkeys(record.MADE_BY, f"{record.VERDICT_HEAD} here |\n|---|---|---|\n")
    assert "ecorded" not in record.verdicts(whole)
    assert "older version, without verdicts: table2." in record.verdicts(whole | {"table2": "- Holds: ..."})


def test_a_page_without_a_marker_is_refused(project, monkeypatch):
    (project / "README.md").write_text("nothing\n")
    with pytest.raises(SystemExit, match="0 places <!-- table1 -->"):
        recorded(project, monkeypatch)


def test_pages_of_the_project_have_their_markers():
    pages = {
        "README.md": "table1",
        "docs/results/claims.md": "verdicts",
        "docs/results/figures.md": "figures",
    }
    for page, name in pages.items():
        text = (record.Path(__file__).parents[2] / page).read_text()
        assert record.filled(record.filled(text, name, "a"), name, "b").count("\nb\n") == 1
