"""Recording updates numbers of pages from tables and figures, and nothing else. The pages agree with the records."""

import re
import shutil
import sys
from pathlib import Path

import numpy as np
import pytest

from docs import record, recorded
from neuma_lib.io.files import write_json
from neuma_lib.paper.image_grid import ImageGrid, save_image_grid
from neuma_lib.paper.published import PAPER
from neuma_lib.paper.random_scenes import random_table
from neuma_lib.paper.tables import chamfer_table
from tests.support.random_results import METHODS, result
from tests.support.table_results import run

ROOT = Path(__file__).resolve().parents[2]
PAGE = "# Title\n\nBefore.\n\n<!-- {0} -->\nold\n<!-- /{0} -->\n\nAfter.\n"
SUMMARY = f"{PAGE.format('summary')}{PAGE.format('verdicts_in_short')}"
RUN = re.compile(
    r"\b[0-9a-f]{7,8}\b|`(snakemake|python|pytest|make|neuma)\b|tests/|^    (snakemake|python|neuma) ",
    re.MULTILINE,
)
"""A commit, a command or a test."""


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
    out = tmp_path / "docs/results"
    out.mkdir(parents=True)
    (tmp_path / "README.md").write_text(PAGE.format("table1"))
    (out / "README.md").write_text(SUMMARY)
    (out / "claims.md").write_text(PAGE.format("verdicts"))
    (out / "figures.md").write_text(PAGE.format("figures"))
    shutil.copytree(ROOT / "config", tmp_path / "config")
    return tmp_path


def record_all(project, monkeypatch, *options) -> tuple[str, str]:
    """The README, and the pages of claims and figures, after a recording."""
    monkeypatch.chdir(project)
    monkeypatch.setattr(sys, "argv", ["record", "--machine", "a machine", "--commit", "abc", *options])
    record.main()
    return (project / "README.md").read_text(), "".join(
        (project / "docs/results" / page).read_text() for page in ("claims.md", "figures.md")
    )


def test_pages_are_updated_from_tables_and_figures(project, monkeypatch):
    readme, page = record_all(project, monkeypatch)
    assert readme.startswith("# Title\n\nBefore.\n") and readme.endswith("<!-- /table1 -->\n\nAfter.\n")
    assert (
        "\nold\n" not in readme and "[six scenes](docs/results/table1.md): commit abc, 36³ cells." in readme
    )
    assert "| NeuMA | 6.0 | 6.0 | 6.0 | 6.0 | 6.0 | 6.0 | 6.0 ± 1.0 |  |" in readme
    assert "*paper*" not in readme and "Median" not in readme
    expected = (
        "| [table1](table1.md) | NeuMA is closer than its prior | **holds** | 6.0 ± 1.0 (NeuMA) against 51.0 ± 1.0"
        " (NCLaw), lower in 6 of 6 | 1.31 against 12.18 |\n\nNot recorded: table2"
    )
    assert expected in page, "other claims are about methods that were not run"
    assert (
        "Made by `snakemake tables figures` and `python" in (project / "docs/results/table1.md").read_text()
    )
    assert "| NeuMA | 0.5 | 0.5 | 0.5 | 0.5 |" in page and "Training saw the views of B." in page
    assert "| A | elastic | 2 | 0.5 | 6.8 % | 1.1 % |" in page
    assert "| Method | A |\n|---|---:|\n| Constants | 75 % |" in page
    # Heights part in the last frame only, and there 0.6 is no step from 0.5 to 0.4.
    assert "0 of 1 (A)" in page
    assert record_all(project, monkeypatch) == (readme, page)


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
    readme, page = record_all(project, monkeypatch)
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
    averages = "| NeuMA | 6.0 | 6.0 | 6.0 | 6.0 | 6.0 | 6.0 | 6.0 ± 1.0 | 6.0 ± 1.0 |"
    assert averages in readme and "| True law |  |  |  |  |  |  |  | 9.0 ± 1.0 |" in readme
    summary = (project / "docs/results/README.md").read_text()
    assert "|  | prior | NeuMA | true law | commit, grid |\n" in summary, (
        "methods without a row have no column"
    )
    assert "| [six scenes](table1.md) | 51.0 ± 1.0 | 6.0 ± 1.0 |  | abc, 36³ cells |" in summary
    assert "converged truths](table1_converged.md) | 51.0 ± 1.0 | 6.0 ± 1.0 | 9.0 ± 1.0 | abc," in summary
    assert "| [random scenes, seed 7, median](random.md) | 8.0 | 2.0 |" in summary
    assert "- **holds**, 1 of 1: NeuMA is closer than its prior ([table1](table1.md))" in summary
    closer = page[page.index("\n\n[table1_converged](table1_converged.md): The true law") :]
    assert "than it: NeuMA in 6 of 6 columns (there by 3.0 of 9.0 mm on average)" in closer
    assert "Made by `snakemake random` and" in (project / "docs/results/random.md").read_text()


def test_settings_of_the_run_are_named(project, monkeypatch):
    record_all(project, monkeypatch, "--configfile", "config/studies/three_chains.yaml")
    table = (project / "docs/results/table1.md").read_text()
    assert "default settings (`config/config.yaml`) with `config/studies/three_chains.yaml`. Made by" in table
    assert "`snakemake --configfile config/studies/three_chains.yaml -- tables figures` and" in table


def test_tables_that_are_not_recorded_are_named(project, monkeypatch):
    _, page = record_all(project, monkeypatch)
    missing = page[page.index("Not recorded: ") :].partition(".\n")[0]
    assert (
        "table1_converged (`snakemake results/table1_converged.csv`), random (`snakemake random`)" in missing
    )
    assert "table1 (" not in missing and "table1_converged](" not in page and "random](" not in page
    tables = recorded.Tables(project / "docs/results")
    whole = dict.fromkeys(recorded.MADE_BY, f"{recorded.VERDICT_HEAD} here |\n|---|---|---|\n")
    tables.markdown = whole
    assert "ecorded" not in recorded.verdicts(tables)
    tables.markdown = whole | {"table2": "- Holds: ..."}
    assert "older version, without verdicts: table2." in recorded.verdicts(tables)


def test_a_page_without_a_marker_is_refused(project, monkeypatch):
    (project / "README.md").write_text("nothing\n")
    with pytest.raises(SystemExit, match="0 places <!-- table1 -->"):
        record_all(project, monkeypatch)


def test_a_number_in_a_sentence_is_that_of_its_table(project, monkeypatch):
    page = project / "docs/page.md"
    page.write_text(
        "It is <!-- table1 neuma Average -->9<!-- / --> mm, <!-- table1 neuma ClayCat tracer_rmse_last_mm -->9 ±\n"
        "1<!-- / --> at the end.\n\n<!-- table table1 tracer_rmse_mm -->\nold\n<!-- /table -->\n"
    )
    record_all(project, monkeypatch)
    text = page.read_text()
    assert text.startswith(
        "It is <!-- table1 neuma Average -->6.0 ± 1.0<!-- / --> mm, <!-- table1 neuma ClayCat"
    )
    assert "tracer_rmse_last_mm -->18.0 ± 3.0<!-- / --> at the end" in text
    assert "| NCLaw | 51.0 ± 1.0 | 51.0 ± 1.0 |" in text and "old" not in text
    assert recorded.pages(project) == {}


@pytest.mark.parametrize(
    ("place", "problem"),
    [
        ("<!-- table9 neuma Average -->1<!-- / -->", r"docs/results has no docs/results/table9.csv"),
        ("<!-- table1 neuma Average chamfer9 -->1<!-- / -->", r"no \('chamfer9', 'neuma'\)"),
        ("<!-- table1 neuma Elsewhere -->1<!-- / -->", "no Elsewhere"),
        ("<!-- table1 neuma -->1<!-- / -->", "needs <!-- TABLE METHOD COLUMN -->"),
    ],
)
def test_a_place_without_a_record_is_refused(project, monkeypatch, place, problem):
    (project / "docs/page.md").write_text(place)
    with pytest.raises(SystemExit, match=problem):
        record_all(project, monkeypatch)


def test_rows_of_another_record_are_not_compared(project, monkeypatch):
    """The true law of the six scenes has another table, which may be older."""
    columns = {column: column for column in PAPER["yardstick"].columns}
    table = chamfer_table(
        {"true_law": {c: [run(4.0)] for c in columns}}, {"true_law": "True law"}, columns, PAPER["yardstick"]
    )
    (project / "results/yardstick.md").write_text(table.markdown())
    (project / "results/yardstick.csv").write_text(table.csv())
    readme, _ = record_all(project, monkeypatch)
    assert "| True law | 4.0 | 4.0 | 4.0 | 4.0 | 4.0 | 4.0 | 4.0 |  |" in readme
    assert "| 6.0 ± 1.0 | 4.0 | abc," in (project / "docs/results/README.md").read_text()
    readme, _ = record_all(project, monkeypatch, "--tables", "table1", "--commit", "def")
    assert "True law" not in readme and "commit def" in readme
    assert "true law" not in (project / "docs/results/README.md").read_text()


def test_diverged_runs_are_marked(tmp_path):
    (tmp_path / "t.csv").write_text(
        "quantity,method,title,A,B,Average,Median,wins,diverged\nx,m,M,1,2,1.5,1.5,0,B\nx,n,N,–,nan,0.01,1,0,\n"
    )
    tables = recorded.Tables(tmp_path)
    assert [tables.cell("t", "m", column) for column in ("A", "B", "Average")] == ["1.0", "2.0†", "1.5†"]
    assert [tables.cell("t", "n", column) for column in ("A", "B", "Average")] == ["–", "–", "< 0.1"]


def test_pages_of_the_project_agree_with_the_records():
    changed = [str(page.relative_to(ROOT)) for page in recorded.pages(ROOT)]
    assert not changed, "run `python -m docs.recorded`"
    figures = (ROOT / "docs/results/figures.md").read_text()
    assert recorded.filled(recorded.filled(figures, "figures", "a"), "figures", "b").count("\nb\n") == 1


def test_measured_numbers_are_generated_or_name_their_run():
    """Lengths and spreads in a section without a generated place need a commit, a command or a test, there or in the
    introduction of the page."""
    for page in [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]:
        text = page.read_text()
        if re.search(r"commit \w+,? .*\d³ cells", text.partition("\n")[0]):
            continue  # a recorded table
        text = re.sub(r"<!-- (\w+) -->\n.*?<!-- /\1 -->", "", text, flags=re.DOTALL)
        text = recorded.NUMBER.sub("", recorded.WHOLE_TABLE.sub("", text))
        introduction, *sections = re.split(r"^## ", text, flags=re.MULTILINE)
        for section in sections or [introduction]:
            if re.search(r"\d( mm| ±)", section):
                heading = section.partition("\n")[0]
                assert RUN.search(section) or RUN.search(introduction), f"{page.relative_to(ROOT)}: {heading}"
