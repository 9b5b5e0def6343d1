"""A splat of the user's under laws that were learned from videos of other objects."""

import json
import re

import numpy as np
import pytest
from project import copied
from splat_files import ball, write_spz

from neuma_lib.io.gaussians import load_gaussians
from neuma_lib.io.hdf5 import read_arrays

RESULTS = "tiny/results"
FIGURE = f"{RESULTS}/figures/i23d.png"


def settings(**splat):
    """Options of Snakemake for a scene with a splat, which falls for 0.1 s."""
    scene = {"splat": {"file": "made/ball.spz", "up": "z", "count": 300, "views": 12, "pixels": 48, **splat}}
    scene |= {"height": 0.2, "size": 0.3, "velocity": [0.0, -2.0, 0.0], "dt": 2e-3, "steps": 50}
    return ["--config", f"scenes={json.dumps({'Splat': scene})}", 'figures={"i23d": ["BouncyBall"]}']


@pytest.fixture(scope="module")
def project(finished, tmp_path_factory):
    """What the tables need is done; a splat of a ball lies beside it."""
    made = finished.clone(tmp_path_factory.mktemp("splats") / "project")
    (made.root / "made").mkdir()
    write_spz(made.root / "made/ball.spz", ball(600, centre=(5.0, -3.0, 2.0)))
    return made


def test_a_learned_law_moves_a_splat(project):
    project.run(FIGURE, f"{RESULTS}/Splat/nclaw/rollout.h5", *settings())
    gaussians = load_gaussians(project.root / f"{RESULTS}/Splat/gaussians.ply")
    assert len(gaussians) == 300
    report = json.loads((project.root / f"{RESULTS}/Splat/gaussians.json").read_text())
    assert report["read"] == 600 and report["kept"] == 300
    for method in ("nclaw", "neuma+law_from=BouncyBall"):
        path, attributes = read_arrays(project.root / f"{RESULTS}/Splat/{method}/rollout.h5")
        assert attributes["dt"] == pytest.approx(2e-3) and path["frames"][-1] == 50
        fallen = path["x"][:, :, 1].mean(axis=1) - path["x"][0, :, 1].mean()
        time = 2e-3 * path["frames"]
        free = time < 0.02  # 0.05 m above the floor, at 2 m/s
        assert free.sum() > 1
        np.testing.assert_allclose(fallen[free], -2.0 * time[free] - 4.9 * time[free] ** 2, atol=1e-3)
        assert (path["x"][:, :, 1] > -0.05).all()
    assert (project.root / FIGURE).stat().st_size > 1000


def test_what_is_done_is_not_done_again_and_the_placement_repeats_what_it_moves(project):
    project.run(FIGURE, *settings())
    assert project.plan(FIGURE, *settings()) == {}
    again = project.plan(FIGURE, *settings(turn=30.0))
    assert again["splat_gaussians"] == again["splat_mesh"] == again["splat_motion"] == 1
    assert not again.keys() & {"material", "prior", "ground_truth", "gaussians", "evaluation"}


@pytest.mark.parametrize(
    "target, says",
    [
        ("Splat/neuma/rollout.h5", "no video to learn a law from"),
        ("Splat/true_law/rollout.h5", "nobody knows the truth"),
        ("Splat/pac_nerf_own+law_from=BouncyBall/rollout.h5", "field"),
        ("Splat/neuma/metrics.json", "No rule|Missing"),
    ],
)
def test_what_a_splat_cannot_have_is_said(project, target, says):
    assert re.search(says, project.run("-n", f"{RESULTS}/{target}", *settings(), succeeds=False))


def test_a_damaged_file_is_one_line(project):
    (project.root / "made/bad.spz").write_bytes(b"nothing")
    said = project.run(f"{RESULTS}/Splat/gaussians.ply", *settings(file="made/bad.spz"), succeeds=False)
    assert re.search(r"splat_gaussians Splat: ERROR: made/bad.spz cannot be read", said)
    assert not (project.root / f"{RESULTS}/Splat/gaussians.ply").exists()


def test_the_figure_asks_for_a_splat(tmp_path, kernels):
    said = copied(tmp_path, kernels).run("-n", FIGURE, succeeds=False)
    assert "no scene has a splat" in said
