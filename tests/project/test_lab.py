"""The simulated lab: it repeats until constants are determined, stops where nothing is gained, and continues."""

import shutil
from pathlib import Path

import pytest

from neuma_lib.io.files import read_json, write_json
from neuma_lib.project.lab import run_lab
from neuma_lib.project.project import Project

ROOT = Path(__file__).resolve().parents[2]
LAUNCH = {
    "height": 0.5,
    "center": [0.5, 0.5],
    "velocity": [0.0, -2.0, 0.0],
    "spin": [0.0, 1.0, 0.0],
    "steps": 256,
}


@pytest.fixture
def folder(tmp_path):
    shutil.copytree(ROOT / "config", tmp_path / "config")
    (tmp_path / "results" / "JellyDuck").mkdir(parents=True)
    return tmp_path / "results" / "JellyDuck"


def workflow(folder: Path, useful: bool = True, fails: int = 99):
    """A function in place of Snakemake, whose standard deviations halve with every video; and its calls."""
    calls = []

    def make(files, target):
        settings, _ = Project.find(folder, files)
        videos = len(settings.video_scenes("JellyDuck"))
        calls.append((Path(target).name, videos))
        if len(calls) >= fails:
            return 1
        if target.endswith("identified.json"):
            # u = (log E, logit nu): its standard deviations are those of the logarithms of G and K up to a factor.
            own = {"values": [12.0, 0.5], "covariance": [[0.04 / 4**videos, 0.0], [0.0, 0.09 / 4**videos]]}
            write_json(
                folder / "identified.json", {"family": "hencky", "best": {"unbounded": own}, "ties": []}
            )
        else:
            candidate = {"kind": "launch", "settings": LAUNCH, "expected": {"G": 0.05, "K": 0.2}}
            write_json(folder / "next.json", {"useful": useful, "candidates": [candidate]})
        return 0

    return make, calls


def test_the_lab_repeats_until_all_constants_are_determined(folder):
    make, calls = workflow(folder)
    assert run_lab(folder, [], 9, make, lambda text: None)
    rounds = read_json(folder / "lab.json")
    assert len(rounds) >= 2 and max(rounds[-1]["reported"].values()) < 0.1 <= max(
        rounds[-2]["reported"].values()
    )
    assert calls[:3] == [("identified.json", 1), ("next.md", 1), ("identified.json", 2)]
    settings, _ = Project.find(folder, [folder.parents[1] / each["file"] for each in rounds[1:]])
    assert settings.scene("JellyDuck_next1").velocity == (0.0, -2.0, 0.0)
    text = (folder / "lab.md").read_text()
    assert "All constants are determined" in text and "| 1 | the existing launch | hencky | G, K |" in text


def test_the_lab_stops_at_its_limit_and_where_nothing_is_gained(folder):
    make, calls = workflow(folder)
    assert run_lab(folder, [], 1, make, lambda text: None) and calls == [("identified.json", 1)]
    assert "maximum of 1 experiments" in (folder / "lab.md").read_text()
    assert run_lab(folder, [], 9, workflow(folder, useful=False)[0], lambda text: None)
    assert "nothing more can be learned" in (folder / "lab.md").read_text()


def test_an_interrupted_lab_continues_with_the_chosen_experiment(folder):
    """The identification of the second video fails first. The lab then continues with it."""
    make, calls = workflow(folder, fails=3)
    assert not run_lab(folder, [], 2, make, lambda text: None) and calls[-1] == ("identified.json", 2)
    make, calls = workflow(folder)
    assert run_lab(folder, [], 2, make, lambda text: None)
    assert calls == [("identified.json", 2)] and len(read_json(folder / "lab.json")) == 2
