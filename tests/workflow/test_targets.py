"""Targets that no rule makes are refused with the nearest ones."""

import re
import sys
from types import SimpleNamespace

import pytest

from neuma_lib.project.project import remember_settings, remembered_settings
from tests.support.errors import refused
from workflow.targets import refuse_unknown, requested_targets


def rule(name, *patterns):
    """A rule with outputs like ``results/{scene}/metrics.json``."""
    expressions = [re.sub(r"\\\{(\w+)\\\}", r"[^/]+", re.escape(pattern)) for pattern in patterns]
    return SimpleNamespace(
        name=name, output=patterns, is_producer=lambda path: any(re.fullmatch(e, path) for e in expressions)
    )


RULES = [
    rule("table", "results/table1.csv"),
    rule("evaluate", "results/ClayCat/{method}/metrics.json"),
    rule("all"),
]
NAMES = ["ClayCat", "neuma"]


@pytest.mark.parametrize(
    "target, near",
    [
        ("results/tabel1.csv", "results/table1.csv"),
        ("results/ClayCatt/neuma/metrics.json", "results/ClayCat/neuma/metrics.json"),
        ("result/ClayCat/neuma/metric.json", "results/ClayCat/neuma/metrics.json"),
        ("results/ClayKat/neuma+rank=4/metrics.json", "results/ClayCat/neuma+rank=4/metrics.json"),
        ("tabel", "table"),
        ("everything", "neuma check"),
    ],
)
def test_the_nearest_targets_are_named(target, near):
    with refused(target, remedy=near):
        refuse_unknown([target], RULES, NAMES)


@pytest.mark.parametrize("name", ["my mug", "Plüschtier"])
def test_a_folder_name_that_no_result_can_have_is_the_cause(name):
    with refused(name, problem=f"'{name}' cannot name a folder", remedy="Rename the capture's folder"):
        refuse_unknown([f"results/{name}/capture.md"], RULES, NAMES)


def test_rules_their_files_and_existing_files_are_targets(tmp_path):
    refuse_unknown(
        ["all", "results/table1.csv", "results/ClayCat/neuma/metrics.json", tmp_path], RULES, NAMES
    )


def test_targets_are_those_of_the_command_line(monkeypatch):
    monkeypatch.setattr(
        sys, "argv", ["snakemake", "-n", "--configfile", "a.yaml", "--", "results/table1.csv", "all"]
    )
    assert requested_targets() == ["results/table1.csv", "all"]


def test_settings_of_an_earlier_run_are_named():
    with refused("results/Mine/a", remedy="--configfile mine.yaml"):
        refuse_unknown(["results/Mine/a"], RULES, NAMES, lambda target: ["mine.yaml"])


def test_a_folder_of_results_remembers_its_settings(tmp_path):
    """Those of the nearest folder above a place; none of them if the run had none, and a missing one is an error."""
    for name in ("config/config.yaml", "mine.yaml"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).touch()
    scene = tmp_path / "results" / "Mine"
    (scene / "neuma").mkdir(parents=True)
    assert remembered_settings(scene / "neuma", tmp_path) == []
    remember_settings(
        tmp_path / "results", "Mine", [tmp_path / "mine.yaml", tmp_path / "config/config.yaml"], tmp_path
    )
    assert remembered_settings(scene / "neuma", tmp_path) == [tmp_path / "mine.yaml"]
    (tmp_path / "mine.yaml").unlink()
    with refused("mine.yaml", remedy="--configfile"):
        remembered_settings(scene, tmp_path)
    remember_settings(tmp_path / "results", "Mine", [tmp_path / "config/config.yaml"], tmp_path)
    assert remembered_settings(scene, tmp_path) == []
