"""From pictures that Blender takes of a simulated object to its free flight, by real runs, beside the truth."""

import json

import numpy as np
import pytest
from project import copied

from neuma_lib.evaluation.demo_captures import Truth, compare_cameras, compare_flight
from neuma_lib.io.hdf5 import read_arrays
from neuma_lib.io.images import read_transforms

FLIGHT = "tiny/results/demo_duck/flight/first.json"


@pytest.fixture
def project(tmp_path):
    pytest.importorskip("cv2")
    pytest.importorskip("pycolmap")
    return copied(tmp_path / "project", tmp_path / "kernels")


def test_a_capture_that_is_not_there_yet_is_planned(project):
    """All jobs up to the comparison are known before Blender has run, and Table 1 needs none of them."""
    plan = project.plan("captures_demo")
    assert plan["demo_photographs"] == 2 and plan["demo_videos"] == 4 and plan["capture_poses"] == 2
    assert (
        plan["capture_registration"] == 4
        and plan["capture_prediction"] == 12
        and plan["demo_evaluation"] == 1
    )
    assert not [
        rule for rule in project.plan("tiny/results/table1.csv") if rule.startswith(("demo_", "capture_"))
    ]


@pytest.mark.slow
def test_free_flight_of_a_filmed_object(project):
    project.run(FLIGHT)
    known = json.loads((project.root / "tiny/data/captures_demo/duck/truth.json").read_text())
    room = read_transforms(project.root / "tiny/data/demo_duck/room/transforms.json")
    photographs = {name.removesuffix(".jpg"): camera for name, camera in known["photographs"].items()}
    rows = {row.what: row.found for row in compare_cameras(room["frames"], photographs, known["cameras"])}
    arrays, _ = read_arrays(project.root / "tiny/data/captures_demo/duck/first.h5")
    truth = Truth(*(arrays[key] for key in ("time", "x", "mass", "tracers")))
    flight = json.loads((project.root / FLIGHT).read_text())
    rows |= {row.what: row.found for row in compare_flight(flight, known, truth, "first")}
    print(json.dumps(rows, indent=1))
    # Half as many pixels each way as the demo captures have, and a third of the photographs: twice their goals.
    assert rows["centres of photographs, largest"] < 10 and rows["centres of video cameras, largest"] < 10
    assert rows["scale, from the cameras"] < 1.0 and rows["up, from the cameras"] < 1.0
    assert rows["direction of gravity, from outlines"] < 1.0 and rows["size of gravity, from outlines"] < 3
    assert rows["v0 of the masks' centre"] < 6
    assert max(value for what, value in rows.items() if what.startswith("offset")) < 1.5
    assert np.isfinite(list(rows.values())).all()
