"""A mesh file as the shape of a scene and of a body: repaired once, an input of all that reads the shape."""

import numpy as np
import pytest
import trimesh

from neuma_lib.io.mesh import read_mesh
from tests.support.project import copied, overlay

pytest.importorskip("pymeshlab")
DATA, RESULTS = "tiny/data", "tiny/results"
READ_THE_SHAPE = {"ground_truth", "render_static", "render_dynamic", "initial_state"}


@pytest.fixture
def project(tmp_path, kernels):
    made = copied(tmp_path / "project", kernels)
    (made.root / "meshes").mkdir()
    open_box = trimesh.creation.box((30.0, 10.0, 20.0))
    trimesh.Trimesh(open_box.vertices, open_box.faces[2:]).export(made.root / "meshes/my box.obj")
    return made


def test_a_mesh_is_repaired_once_and_an_input_of_what_reads_the_shape(project):
    changes = overlay(
        scenes={"Box": {"like": "BouncyBall", "shape": "meshes/my box.obj", "size": 0.3, "height": 0.4}},
        experiments={
            "boxes": {
                "title": "boxes",
                "bodies": [
                    {"scene": "BouncyBall", "shape": "meshes/my box.obj", "size": 0.2, "height": 0.6},
                    {"scene": "Box"},
                ],
                "steps": 10,
            }
        },
    )
    solid = f"{DATA}/Box/solid_0.ply"
    targets = [f"{RESULTS}/Box/neuma/metrics.json", f"{RESULTS}/Box/initial_state.json"]
    plan = project.plan(*changes, *targets, f"{RESULTS}/experiments/boxes/neuma/metrics.json")
    assert {job.rule for job in plan.jobs if solid in job.inputs} == READ_THE_SHAPE
    assert {*plan.makers[solid].inputs} == {f"{DATA}/kernels/geometry.ready", "meshes/my box.obj"}
    bodies = f"{DATA}/experiments/boxes"
    # the second body is the reconstructed box, whose true shape only the truth reads
    start = plan.one("experiment_start").inputs
    assert f"{bodies}/solid_0.ply" in start and f"{bodies}/solid_1.ply" not in start
    assert {f"{bodies}/solid_{k}.ply" for k in (0, 1)} <= {*plan.makers[f"{bodies}/truth.h5"].inputs}

    project.run(*changes, solid, f"{DATA}/Box/truth.h5")
    np.testing.assert_allclose(read_mesh(project.root / solid).extents, [30.0, 10.0, 20.0], rtol=1e-3)
    log = (project.root / f"{RESULTS}/logs/Box/0/solid.log").read_text()
    assert "meshes/my box.obj: 10 faces" in log and "closed holes with 2 faces" in log
    trimesh.creation.box((20.0, 10.0, 20.0)).export(project.root / "meshes/my box.obj")
    plan = project.plan(*changes, f"{DATA}/Box/truth.h5")
    assert {"solid", "ground_truth"} <= {*plan}
