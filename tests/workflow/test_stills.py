"""Stiffness from a folder of stills by Snakemake, a prediction with it, their table and figure."""

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
    beam.write_record(root, [beam.image_of(beam.resting_beam(0.03), 93.0)])
    clamp = {"lowest": [beam.CLAMP, -0.1, -0.1], "highest": [0.2, 0.1, 0.1]}
    body = {"record": "twin", "mesh": "beam.obj", "unit": 0.01, "placement": beam.PLACEMENT.tolist()}
    body |= {"clamps": {"head": clamp}, "hidden": clamp | {"lowest": [beam.HIDDEN, -0.1, -0.1]}}
    bodies = {"beam": body, "other": body | {"predicted_from": "beam"}}
    settings = overlay(
        stills={"root": "records", "bodies": bodies},
        advanced={"stills.sizes": [0.06, 0.03], "stills.photographs": False},
    )
    targets = [f"{RESULTS}/stills.csv", f"{RESULTS}/figures/stills.png"]
    assert project.plan(*settings, *targets) == {"still_fit": 2, "stills_table": 1, "stills": 1}
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
