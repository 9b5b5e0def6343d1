"""Stiffness from a folder of stills by Snakemake, predictions of a still and a swing with it, table and figures."""

import json

import numpy as np
import pytest
from PIL import Image

from tests.support import hanging_beam as beam
from tests.support.project import copied, overlay

RESULTS = "tiny/results"


def test_a_beam_predicts_another_record(tmp_path, kernels):
    """The second record shows the same beam. Elements of 60 and 30 mm and a single still keep it short."""
    pytest.importorskip("cv2")
    project = copied(tmp_path / "project", kernels)
    root = project.root / "records"
    root.mkdir()
    still = beam.image_of(beam.resting_beam(0.03), 93.0)
    beam.write_record(root, [still])
    beam.write_swing(root, {0.1: beam.depth_camera(still)})
    clamp = {"lowest": [beam.CLAMP, -0.1, -0.1], "highest": [0.2, 0.1, 0.1]}
    body = {"record": "twin", "mesh": "beam.obj", "unit": 0.01, "placement": beam.PLACEMENT.tolist()}
    body |= {"clamps": {"head": clamp}, "hidden": clamp | {"lowest": [beam.HIDDEN, -0.1, -0.1]}}
    bodies = {"beam": body, "other": body | {"predicted_from": "beam"}}
    region = {"lowest": beam.HELD[0].tolist(), "highest": beam.HELD[1].tolist()}
    swing = {"body": "beam", "still": "twin", "silhouettes": "swing", "held": region}
    settings = overlay(
        stills={"root": "records", "bodies": bodies, "swings": {"fall": swing}},
        advanced={"stills.sizes": [0.06, 0.03], "stills.photographs": False, "stills.cells": [0.03]},
    )
    targets = [f"{RESULTS}/stills.csv", f"{RESULTS}/figures/stills.png", f"{RESULTS}/swings/fall.json"]
    plan = project.plan(*settings, *targets)
    rules = {"still_fit": 2, "stills_table": 1, "stills": 1, "swing": 1}
    assert {rule: jobs for rule, jobs in plan.items() if rule != "kernels"} == rules
    assert any(name.endswith("swing/label_00.png") for name in plan.one("swing").inputs)
    project.run(*settings, *targets)
    fitted, given = (
        json.loads((project.root / f"{RESULTS}/stills/{name}.json").read_text()) for name in bodies
    )
    assert fitted["ratio"] == pytest.approx(93.0, rel=0.05)
    assert given["clamps"]["head, head"]["ratio"] == fitted["clamps"]["head"]["ratio"]
    assert given["clamps"]["head, head"]["contour_rms"] < 1
    assert (project.root / f"{RESULTS}/stills.md").read_text().count("| beam |") == 2
    with Image.open(project.root / targets[1]) as image:
        colours = np.unique(np.asarray(image.convert("RGB")).reshape(-1, 3), axis=0)
    assert (150, 150, 150) in map(tuple, colours.tolist())  # both silhouettes
    moved = json.loads((project.root / f"{RESULTS}/swings/fall.json").read_text())["clamps"]["head"]
    assert (
        moved["hang"]
        == fitted["clamps"]["head"]["ratio"]
        == pytest.approx(moved["grids"][0]["predicted"]["ratio"])
    )
    assert (project.root / f"{RESULTS}/swings/fall.png").stat().st_size > 5000
