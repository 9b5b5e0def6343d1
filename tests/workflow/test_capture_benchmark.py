"""From images that Blender renders of a simulated object to its place in the video, compared with the truth."""

import json

import numpy as np
import pytest
import yaml

from neuma_lib.io.hdf5 import read_arrays
from neuma_lib.io.images import read_transforms
from neuma_lib.project.loading import read_yaml
from studies.capture_benchmark.evaluation import Truth, compare_cameras, compare_registration
from tests.support.project import TABLE, Project, copied

PLACED = "tiny/results/demo_fish_first/registration.json"
STUDY = (
    "--snakefile",
    "studies/capture_benchmark/Snakefile",
    "--configfile",
    "tests/workflow/tiny.yaml",
    "tests/workflow/capture_benchmark.yaml",
    "--cores",
    "2",
)


@pytest.fixture
def project(tmp_path, kernels):
    pytest.importorskip("cv2")
    pytest.importorskip("pycolmap")
    return Project(copied(tmp_path / "project", kernels).root, STUDY)


def test_a_capture_that_is_not_there_yet_is_planned(project):
    """All jobs up to the comparison are known before Blender has run, and Table 1 needs none of them."""
    planned = project.plan("captures_demo", TABLE)
    plan = planned.behind("captures_demo")
    assert plan["demo_photographs"] == 2 and plan["demo_videos"] == 4 and plan["capture_poses"] == 2
    assert plan["capture_registration"] == 4 and plan["predict"] == 12 and plan["demo_evaluation"] == 1
    table = planned.behind(TABLE)
    assert table["chamfer_table"] and not [r for r in table if r.startswith(("demo_", "capture_"))]


@pytest.mark.slow
def test_a_filmed_object_is_found_where_it_was(project):
    tiny = project.root / "tests/workflow/tiny.yaml"
    settings = read_yaml(tiny)
    fit = {"iterations": 300, "initial_count": 800, "hull_resolution": 64}
    tiny.write_text(yaml.safe_dump({**settings, "gaussians": fit}))
    project.run(PLACED)
    known = json.loads((project.root / "tiny/data/captures_demo/fish/truth.json").read_text())
    room = read_transforms(project.root / "tiny/data/demo_fish/room/transforms.json")
    photographs = {name.removesuffix(".jpg"): camera for name, camera in known["photographs"].items()}
    rows = {row.what: row for row in compare_cameras(room["frames"], photographs, known["cameras"])}
    arrays, _ = read_arrays(project.root / "tiny/data/captures_demo/fish/first.h5")
    truth = Truth(*(arrays[key] for key in ("time", "x", "mass", "tracers")))
    placed, velocity = (
        json.loads((project.root / path).read_text())
        for path in (PLACED, PLACED.replace("registration", "velocity"))
    )
    rows |= {row.what: row for row in compare_registration(placed, velocity, known, truth, "first")}
    print("\n".join(f"{row.what}: {row.value:.3g} {row.unit}" for row in rows.values()))
    # Half as many pixels each way as the demo captures have, and a third of the photographs: twice their goals. Fewer
    # than 20 photographs do not determine the centre of their lens, by which all cameras are turned.
    relative = {
        what: row.value / row.goal for what, row in rows.items() if row.goal and "directions" not in what
    }
    assert len(relative) == 8 and max(relative.values()) < 2, relative
    assert rows["size of gravity, from the placed object"].value < 3
    assert max(row.value for what, row in rows.items() if what.startswith("offset")) < 1.5
    assert np.isfinite([row.value for row in rows.values()]).all()
