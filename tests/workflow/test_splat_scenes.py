"""A splat of the user's under a law that is from elsewhere, and its motion for other programs."""

import json
import re

import numpy as np
import pytest
from PIL import Image
from plyfile import PlyData

from neuma_lib.io.exported import about_law
from neuma_lib.io.gaussians import load_gaussians
from neuma_lib.io.hdf5 import read_arrays
from neuma_lib.io.laws import save_law
from neuma_lib.io.splats import load_splat
from neuma_lib.mechanics.analytic import analytic_law
from neuma_lib.splatting.culling import morton_order
from tests.support.project import copied, overlay
from tests.support.splat_files import ball, write_spz

RESULTS = "tiny/results"
FIGURE = f"{RESULTS}/figures/i23d.png"


DT = 2e-3  # of the scene that the law is from; the splat's frames are counted in half of it
LAW = {"elasticity": {"name": "fixed_corotated", "E": 3e4, "nu": 0.3}, "plasticity": {"name": "identity"}}
EXPORT = f"{RESULTS}/Splat/nclaw+law_from=BouncyBall/export"


def settings(**splat):
    """Options of Snakemake for a splat that falls for 0.1 s, under a law that was passed on in a file."""
    scene = {"splat": {"file": "made/ball.spz", "up": "z", "count": 300, **splat}}
    scene |= {"height": 0.2, "size": 0.3, "velocity": [0.0, -2.0, 0.0], "dt": DT / 2, "steps": 100}
    scenes = {"Splat": scene, "BouncyBall": {"prior": "made/law.safetensors"}}
    return overlay(
        scenes=scenes,
        figures={"methods": ["nclaw"]},
        viewer={"methods": ["nclaw+law_from=BouncyBall"]},
        advanced={
            "scenes.Splat.splat.views": 12,
            "scenes.Splat.splat.pixels": 48,
            "figures.i23d": ["BouncyBall"],
        },
        dataset={"frames": 11},
    )


@pytest.fixture(scope="module")
def project(tmp_path_factory, kernels):
    """A splat of a ball and the file of a law lie in the project."""
    made = copied(tmp_path_factory.mktemp("splats"), kernels)
    (made.root / "made").mkdir()
    write_spz(made.root / "made/ball.spz", ball(600, centre=(5.0, -3.0, 2.0)))
    law = analytic_law(LAW, dt=DT)
    save_law(made.root / "made/law.safetensors", law, about_law(law, DT))
    return made


def test_a_law_from_elsewhere_moves_a_splat_and_the_motion_can_be_taken_away(project):
    files = ["gaussians", "compressed", "particles.h5", "surface.glb", "motion.gif"]
    viewer = f"{RESULTS}/Splat/viewer.html"
    project.run(*settings(), FIGURE, viewer, *(f"{EXPORT}/{file}" for file in files))
    gaussians = load_gaussians(project.root / f"{RESULTS}/Splat/gaussians.ply")
    assert len(gaussians) == 300
    report = json.loads((project.root / f"{RESULTS}/Splat/gaussians.json").read_text())
    assert report["read"] == 600 and report["kept"] == 300
    path, attributes = read_arrays(project.root / EXPORT / "../rollout.h5")
    assert attributes["dt"] == pytest.approx(DT) and path["frames"].tolist() == list(range(0, 51, 5))
    fallen = path["x"][:, :, 1].mean(axis=1) - path["x"][0, :, 1].mean()
    time = DT * path["frames"]
    free = time < 0.02  # 0.05 m above the floor, at 2 m/s
    assert free.sum() == 2
    # symplectic Euler falls g dt t / 2 farther
    np.testing.assert_allclose(
        fallen[free], -2.0 * time[free] - 4.905 * time[free] * (time[free] + DT), atol=1e-4
    )
    # contact of particles stops their centres within a quarter of a cell
    assert (path["x"][:, :, 1] > -0.25 / 14).all()
    assert (project.root / FIGURE).stat().st_size > 1000

    exported, _ = read_arrays(project.root / f"{EXPORT}/particles.h5")
    np.testing.assert_array_equal(exported["x"], path["x"])
    np.testing.assert_allclose(exported["time"], time)
    assert exported["mass"].sum() == pytest.approx(1000 * exported["vol0"].sum(), rel=1e-5)
    for k in (0, 10):
        rows = PlyData.read(project.root / f"{EXPORT}/particles/{k:04d}.ply")["vertex"]
        np.testing.assert_array_equal(np.stack([rows[axis] for axis in "xyz"], axis=1), path["x"][k])
        still, packed = (
            load_splat(project.root / f"{EXPORT}/{name}")
            for name in (f"gaussians/{k:04d}.ply", f"compressed/{k:04d}.compressed.ply")
        )
        assert len(still) == len(packed) == 300
        # in the order of a curve, to a part in 1023 of their ranges
        centres = still.means.numpy()[morton_order(gaussians.means.double().numpy())]
        np.testing.assert_allclose(packed.means.numpy(), centres, atol=0.6 * np.ptp(centres) / 1023)
    start = load_splat(project.root / f"{EXPORT}/gaussians/0000.ply")
    np.testing.assert_allclose(start.means, gaussians.means, atol=1e-6)
    np.testing.assert_allclose(
        start.covars(), gaussians.covars(), atol=1e-6 * float(gaussians.covars().max())
    )
    with Image.open(project.root / f"{EXPORT}/motion.gif") as image:
        assert image.n_frames == 11
    page = (project.root / viewer).read_text()
    meta = json.loads(re.search(r'id="meta">(.*?)</script>', page)[1])
    assert [motion["name"] for motion in meta["motions"]] == ["nclaw+law_from=BouncyBall"]
    assert meta["steps"] == list(range(0, 101, 10)) and meta["motions"][0]["means"]["count"] == 300


def test_what_is_done_is_not_done_again_and_the_placement_repeats_what_it_moves(project):
    assert project.plan(*settings(), FIGURE) == {}
    again = project.plan(*settings(turn=30.0), FIGURE)
    assert again["splat_gaussians"] == again["splat_mesh"] == again["predict_splat"] == 1
    assert not again.keys() & {"fit_neuma", "prior", "ground_truth", "gaussians", "evaluate"}


UNKNOWN = "true law and motion of a captured object, a splat, or each of several bodies are unknown"


@pytest.mark.parametrize(
    "target, message",
    [
        ("Splat/neuma/rollout.h5", "no video to learn a law from"),
        ("Splat/true_law/rollout.h5", UNKNOWN),
        ("Splat/pac_nerf_own+law_from=BouncyBall/rollout.h5", "field"),
        ("Splat/neuma/metrics.json", "no rule makes|Missing"),
    ],
)
def test_what_a_splat_cannot_have_is_refused(project, target, message):
    assert re.search(message, project.run("-n", *settings(), f"{RESULTS}/{target}", succeeds=False))


def test_a_damaged_file_is_one_line(project):
    (project.root / "made/bad.spz").write_bytes(b"nothing")
    output = project.run(*settings(file="made/bad.spz"), f"{RESULTS}/Splat/gaussians.ply", succeeds=False)
    assert re.search(r"splat_gaussians Splat: ERROR: made/bad.spz: cannot be read", output)
    assert not (project.root / f"{RESULTS}/Splat/gaussians.ply").exists()
