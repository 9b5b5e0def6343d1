"""Records of stills: reading, both poses of a marker, fits over clamps and meshes, and their table."""

import json
import math

import numpy as np
import pytest

from neuma_lib.capture.calibration.marker import marker_poses
from neuma_lib.config.stills import RestingBodyConfig, StillsConfig
from neuma_lib.fitting.resting_records import fit_record, over_clamps, predict_record
from neuma_lib.io.datasets.stills import read_stills, still_files
from neuma_lib.io.mesh_files import read_any_mesh
from neuma_lib.paper.stills_table import stills_table
from tests.support import hanging_beam as beam
from tests.support.errors import refused

RATIO = 93.0
REGION = {"lowest": [beam.CLAMP, -0.1, -0.1], "highest": [0.2, 0.1, 0.1]}
BODY = {
    "record": "twin",
    "mesh": "beam.obj",
    "unit": 0.01,
    "placement": (beam.PLACEMENT + [0.002, -0.002, 0.003]).tolist(),
    "clamps": {"7 cm": REGION, "9 cm": REGION | {"lowest": [0.09, -0.1, -0.1]}},
    "hidden": REGION | {"lowest": [beam.HIDDEN, -0.1, -0.1]},
}


@pytest.fixture(scope="module")
def record(tmp_path_factory):
    """A folder with two stills of a beam with mu / rho = RATIO that is clamped from 7 cm on."""
    root = tmp_path_factory.mktemp("record")
    beam.write_record(root, [beam.image_of(beam.resting_beam(0.02), RATIO)] * 2)
    return root


def test_stills_are_read_in_the_conventions_of_the_library(record):
    stills = read_stills(record, "twin")
    assert len(stills) == 2 and stills[0].mask.shape == (beam.HEIGHT, beam.WIDTH)
    np.testing.assert_allclose(stills[0].K, beam.K)
    np.testing.assert_allclose(stills[0].marker, beam.MARKER)
    np.testing.assert_allclose(stills[1].marker_pixels, beam.observe(stills[1].mask, 2).marker_pixels)
    assert still_files(record, "twin", "mask") == [str(record / f"mask_{k}.png") for k in (0, 1)]
    with refused("frames.json", problem="'swing'", remedy="twin"):
        read_stills(record, "swing")
    with refused("frames.json", remedy="stills.root"):
        read_stills(record / "elsewhere", "twin")


def test_a_marker_has_two_poses_of_which_one_is_true():
    pytest.importorskip("cv2")
    local = beam.MARKER @ beam.POSE[:3, :3].T + beam.POSE[:3, 3]
    pixels = local @ beam.K.T
    pixels = pixels[:, :2] / pixels[:, 2:]
    poses = marker_poses(beam.MARKER, pixels, beam.K)
    np.testing.assert_allclose(poses[0], beam.POSE, atol=1e-5)
    assert len(poses) == 2 and np.linalg.norm(poses[1][:3, :3] - beam.POSE[:3, :3]) > 0.5
    for pose in poses:  # both explain the corners within a pixel
        seen = (beam.MARKER @ pose[:3, :3].T + pose[:3, 3]) @ beam.K.T
        assert np.abs(seen[:, :2] / seen[:, 2:] - pixels).max() < 1


@pytest.mark.slow
def test_a_record_is_fitted_under_each_clamp_and_predicts_another(record):
    """The true clamp has the true stiffness. A deeper clamp lengthens the beam, which must then be stiffer."""
    settings, stills = RestingBodyConfig(**BODY), read_stills(record, "twin")
    mesh, poses = read_any_mesh(record / "beam.obj"), [beam.POSE]
    steps = []
    result = fit_record(mesh, settings, stills, poses, (0.03, 0.02), lambda *step: steps.append(step))
    assert steps[-1] == (8, 8)
    true, deep = result["clamps"].values()
    assert true["ratio"] == pytest.approx(RATIO, rel=0.05) and len(true["stills"]) == 2
    assert 1.08 < deep["ratio"] / true["ratio"] < 1.25
    # two stills differ in the noise of the marker only
    assert true["stills_std"] < true["noise_std"] < true["log_std"] < 0.1
    assert true["contour_rms"] < 0.8 and true["iou"] > 0.98
    given = predict_record(mesh, settings, stills[:1], poses, 0.03, {"true": RATIO, "soft": 60.0})["clamps"]
    assert list(given) == ["7 cm, true", "7 cm, soft", "9 cm, true", "9 cm, soft"]
    assert given["7 cm, true"]["contour_rms"] < 0.8 < given["7 cm, soft"]["contour_rms"]
    csv, markdown = stills_table({"Twin": result, "Other": {"clamps": given, "predicted_from": "twin"}})
    assert csv.count("\n") == 1 + 3 + 4 and "| Other (predicted) | 9 cm, soft | 60.0 |" in markdown
    json.dumps(result)


def test_the_uncertainty_over_clamps_contains_each():
    clamps = {"a": {"ratio": 90.0, "log_std": 0.02}, "b": {"ratio": 110.0, "log_std": 0.03}}
    both = over_clamps(clamps)
    half = math.log(110 / 90) / 2
    assert both["ratio"] == pytest.approx(math.sqrt(90 * 110)) and both["clamp_std"] == pytest.approx(half)
    assert both["log_std"] == pytest.approx(math.hypot(half, 0.03))


@pytest.mark.parametrize(
    "wrong, where",
    [
        ({"sizes": (0.01, 0.02)}, "sizes"),
        (
            {"bodies": {"beam": BODY, "spine": BODY | {"predicted_from": "bean"}}},
            "bodies.spine.predicted_from",
        ),
        ({"bodies": {"beam": BODY | {"hidden": {"lowest": [0, 0, 0], "highest": [1, 1, 0]}}}}, "highest"),
    ],
)
def test_settings_are_checked(wrong, where):
    with pytest.raises(ValueError, match=where):
        StillsConfig(**wrong)
