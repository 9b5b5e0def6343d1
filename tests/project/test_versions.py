"""Results name the versions that they were made with, and `neuma check` those that differ now."""

import shutil
from pathlib import Path
from types import SimpleNamespace

import pytest

from neuma_lib.cli import main
from neuma_lib.project import versions

ROOT = Path(__file__).resolve().parents[2]


def job(folder: Path, name: str) -> Path:
    """The log of a job that ran now."""
    stage = pytest.importorskip("workflow.stage")
    log = folder / "results/logs" / f"{name}.log"
    fields = {"rule": name, "wildcards": (), "log": [str(log)], "config": {}}
    stage.run_script(lambda *parts: None, SimpleNamespace(**fields, input=None, output=None, params=None))
    return log


def test_an_update_is_noted_with_the_jobs_that_it_concerns(tmp_path, monkeypatch, capsys):
    shutil.copytree(ROOT / "config", tmp_path / "config")
    monkeypatch.chdir(tmp_path)
    logs = [job(tmp_path, name) for name in ("gaussians", "velocity", "film")]
    assert versions.line() in logs[0].read_text()
    assert main(["check"]) == 0 and "note" not in capsys.readouterr().out
    known = versions.installed()
    updated = {**known, "numpy": "99.0"}
    with monkeypatch.context() as later:
        later.setattr(versions, "installed", lambda: updated)
        job(tmp_path, "film")  # repeated after the update
        assert main(["check"]) == 0
        note, summary = capsys.readouterr().out.splitlines()
    assert f"2 of 3 jobs ran with numpy {known['numpy']}, but numpy 99.0 is installed" in note
    assert "--forceall" in note and "no problems" in summary


@pytest.mark.core
def test_logs_without_versions_are_ignored(tmp_path):
    (tmp_path / "logs").mkdir()
    (tmp_path / "logs/old.log").write_bytes(b"\xff core seconds: 1.00 to start\n")
    assert versions.changes(tmp_path) == versions.changes(tmp_path / "none") == []
    assert versions.installed().keys() >= {"python", "numpy"}
