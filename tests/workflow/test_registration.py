"""The photographed object is placed into its video, and the video converted to the simulator's clock, by Snakemake."""

import json

import numpy as np
import pytest
import torch
from PIL import Image
from scipy.spatial.transform import Rotation

from neuma_lib.coupling.binding import Binding
from neuma_lib.coupling.initial_motion import InitialMotion
from neuma_lib.io.files import read_json, write_json
from neuma_lib.io.gaussians import load_gaussians, save_gaussians
from neuma_lib.io.images import OPENGL_TO_OPENCV, load_views, write_transforms
from neuma_lib.io.mesh import read_mesh, write_mesh
from neuma_lib.io.particles import load_particles, load_reconstruction, save_binding, save_particles
from tests.support.flight_scene import GAINS, PLACE, VELOCITY, ellipsoid_body, filmed, true_motion
from tests.support.project import copied

OFFSET, SIZE, FRAMES = 0.0035, (80, 60), 10
RULES = ("--allowed-rules", "capture_registration", "capture_video", "kernels")
VIDEO = "tiny/data/mug_first/dynamic/transforms.json"
FILES = ("gaussians.ply", "mesh.ply", "sampled_particles.h5", "particles.h5", "binding.h5", "velocity.json",
         "registration.json", "registration.png")  # fmt: skip


def write_capture(root, name, body, sights, stretch):
    """What comes before the registration: the object as photographed, mattes of two cameras, the parabola.

    Args:
        stretch: factor of all times.
    """
    capture, data, results = (
        root / f"{folder}/{name}" for folder in ("captures", "tiny/data", "tiny/results")
    )
    for name in ("photos/0.png", "stills/a.png", "stills/b.png", "videos/a.mp4", "videos/b.mp4"):
        (capture / name).parent.mkdir(parents=True, exist_ok=True)
        Image.new("RGB", (8, 8)).save(capture / name, "PNG")
    (capture / "capture.yaml").write_text("board: {square: 0.03}\n")
    for sight in sights:
        folder = data / f"videos/first/{sight.name}"
        folder.mkdir(parents=True)
        pose = (np.linalg.inv(sight.viewmat) @ OPENGL_TO_OPENCV).tolist()
        K = sight.K
        frames = []
        for k, (time, image) in enumerate(zip(sight.times, sight.images)):
            Image.fromarray(image).save(folder / f"{k:05d}.png")
            frames.append(
                {
                    "file_path": f"{k:05d}.png",
                    "transform_matrix": pose,
                    "step": k,
                    "time": 3.0 + stretch * (float(time) - 3.0),
                }
            )
        lens = {"fl_x": K[0, 0], "fl_y": K[1, 1], "cx": K[0, 2], "cy": K[1, 2], "w": SIZE[0], "h": SIZE[1]}
        write_transforms(folder / "transforms.json", {}, [{**frame, **lens, "view": 0} for frame in frames])
        write_json(results / f"frames/first/{sight.name}.json", {"height": SIZE[1]})
    (data / "static").mkdir()
    Image.new("RGBA", (8, 8), "red").save(data / "static/0.png")
    lens = {"fl_x": 8, "fl_y": 8, "cx": 4, "cy": 4, "w": 8, "h": 8}
    shot = {"file_path": "0.png", "transform_matrix": np.eye(4).tolist()}
    write_transforms(data / "static/transforms.json", lens, [shot])
    names = ("a", "b")
    velocity = VELOCITY - 0.01 if stretch == 1 else VELOCITY / stretch
    flight = {
        "start_s": 3.0, "x0_m": (PLACE + 0.003).tolist(), "v0_m_s": velocity.tolist(),
        "gravity_m_s2": [0.0, -9.7, 0.0], "spin_rad_s": None, "spin_deviation_rad_s": None,
        "offsets_s": dict(zip(names, (0.0, 0.002))), "offsets_deviation_s": dict(zip(names, (0.0, 0.001))),
        "frames": {name: [0, FRAMES - 1] for name in names},
    }  # fmt: skip
    write_json(results / "flight/first.json", flight)
    save_gaussians(results / "gaussians.ply", body.gaussians)
    x = torch.tensor(body.particles).float()
    for name in ("sampled_particles.h5", "particles.h5"):
        save_particles(results / name, x, torch.full_like(x[:, 0], 1e-6), {"kind": name})
    count = len(body.gaussians)
    one = Binding(torch.arange(count + 1), torch.arange(count), torch.ones(count), (count, len(x)))
    save_binding(results / "binding.h5", one)
    write_mesh(
        results / "mesh.ply", body.particles[:4], np.array([[0, 1, 2], [0, 3, 1], [0, 2, 3], [1, 3, 2]])
    )


@pytest.fixture(scope="module")
def placed(tmp_path_factory, kernels):
    """A run on two captures. The times of the second are off by 10 percent, as if of another frame rate."""
    project = copied(tmp_path_factory.mktemp("registration") / "project", kernels)
    project.body = ellipsoid_body(count=150)
    project.motion = true_motion(project.body, Rotation.random(random_state=1).as_matrix())
    sights = filmed(project.body, project.motion, frames=FRAMES, offset=OFFSET, size=SIZE)
    for name, stretch in (("mug", 1.0), ("slow", 1.1)):
        write_capture(project.root, name, project.body, sights, stretch)
    project.output = project.run(
        "--keep-going", *RULES, "--", VIDEO, "tiny/results/slow_first/registration.json", succeeds=False
    )
    return project


def test_placed_files_are_of_one_body_that_moves_as_it_was_filmed(placed):
    body, motion = placed.body, placed.motion
    assert "IoU" in placed.output
    results = placed.root / "tiny/results/mug_first"
    assert all((results / file).is_file() for file in FILES)
    placement = read_json(results / "registration.json")
    start = InitialMotion.of(read_json(results / "velocity.json"))
    at = np.array([placement["t0_s"] - 3.0])
    (R,), (spin,) = motion.turn(at)
    (centre,), (velocity,) = motion.place(at)
    off = Rotation.from_matrix(np.array(placement["rotation"]) @ R.T).magnitude()
    assert np.degrees(off) < 1.5 and np.linalg.norm(start.centre - centre) < 0.003
    assert np.linalg.norm(start.velocity - velocity) < 0.03 * np.linalg.norm(velocity)
    assert np.linalg.norm(start.spin - spin) < 0.1 * np.linalg.norm(spin)
    assert placement["offsets_s"]["b"] == pytest.approx(OFFSET, abs=3e-4)
    np.testing.assert_allclose([placement["gains"][k] for k in "ab"], GAINS[:2], rtol=0.03)
    # All files are moved alike, and fit together.
    body_there = load_reconstruction(
        *(results / f for f in ("particles.h5", "binding.h5", "gaussians.ply")), 1000.0
    )
    x = body.particles @ np.array(placement["rotation"]).T + placement["translation"]
    np.testing.assert_allclose(body_there.x0, x, atol=1e-6)
    np.testing.assert_allclose(x.mean(axis=0), start.centre, atol=1e-6)
    np.testing.assert_allclose(read_mesh(results / "mesh.ply", watertight=False).vertices, x[:4], atol=1e-6)
    sampled, _, attributes = load_particles(results / "sampled_particles.h5")
    np.testing.assert_allclose(sampled, x, atol=1e-6)
    assert attributes["kind"] == "sampled_particles.h5"
    means = body.gaussians.means.numpy() @ np.array(placement["rotation"]).T + placement["translation"]
    np.testing.assert_allclose(load_gaussians(results / "gaussians.ply").means, means, atol=1e-5)
    with Image.open(results / "registration.png") as picture:
        assert picture.width > 1000
    frames = read_json(placed.root / VIDEO)["frames"]
    assert {frame["view"] for frame in frames} == {0, 1} and min(frame["step"] for frame in frames) >= 0
    images, _ = load_views(placed.root / VIDEO)
    assert len(images) == len(frames)
    assert json.loads((results / "registration.json").read_text())["ambiguous"] == ""
    assert placed.plan(*RULES, "--", VIDEO) == {}


def test_gravity_that_the_placed_object_does_not_show_stops(placed):
    """Videos with a wrong frame rate, which the fall of the silhouettes, written by hand here, did not reveal."""
    assert "gravity is 0.8" in placed.output and "frame rate is 1.1" in placed.output
    assert "Traceback" not in placed.output
    assert not any((placed.root / "tiny/results/slow_first" / file).exists() for file in FILES)
