"""A specimen of the settings: its records, anywhere on the disk, are inputs of a fit and a figure."""

import json

import numpy as np
import pytest

from neuma_lib.coupling.markers import MarkerTracks
from tests.support.markers import write_markers
from tests.support.project import copied, overlay

LAW = {
    "elasticity": {"name": "neo_hookean", "E": 1e5, "nu": 0.3},
    "viscosity": {"name": "kelvin_voigt", "viscosity": 50.0},
}


@pytest.mark.slow
def test_a_specimen_is_fitted_to_records_outside_the_project(tmp_path, kernels):
    """The record is a damped cosine with a sag and a frequency that go together for a beam. Few cells make it quick."""
    project = copied(tmp_path / "project", kernels)
    times = np.arange(0.0, 0.8, 0.01)
    later = np.clip(times - 0.1, 0.0, None)
    fall = -8e-3 * (1 - np.exp(-2.0 * later) * np.cos(2 * np.pi * 6.4 * later))
    x = np.array([[0.09, 0.01, 0.0], [0.09, -0.01, 0.0]]) + np.zeros((len(times), 1, 1))
    x[..., 1] += fall[:, None]
    write_markers(tmp_path / "a.csv", MarkerTracks(times, x), ("p", "q"))
    specimen = {
        "folder": str(tmp_path),
        "records": [{"file": "a.csv"}],
        "markers": ["p", "q"],
        "size": [0.1, 0.03, 0.03],
        "density": 1000,
        "root": [0.0, 0.001],
        "axis": [0.0, 0.001],
        "law": LAW,
        "fitted": ["E"],
        "duration": 0.6,
    }
    folder, advanced = "tiny/results/specimens/strip", {"specimens.strip.cells": [2]}
    changes = overlay(specimens={"strip": specimen}, advanced=advanced)
    plan = project.plan(*changes, f"{folder}/fit.json")
    assert str(tmp_path / "a.csv") in plan.one("specimen").inputs
    project.run(*changes, f"{folder}/fit.json")
    (fit,) = json.loads((project.root / folder / "fit.json").read_text())["fits"]
    assert fit["cells"] == 2 and fit["law"]["viscosity"]["viscosity"] == pytest.approx(50.0)
    (record,) = fit["records"]
    assert abs(record["measured"]["frequency"] - 6.4) < 0.05
    assert abs(record["predicted"]["frequency"] / 6.4 - 1) < 0.1
    assert (project.root / folder / "fit.png").stat().st_size > 5000
