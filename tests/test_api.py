"""The public API on small scenes: the README's example, a scene in memory and one in a folder of results."""

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
import yaml
from PIL import Image

import neuma_lib as nm
from neuma_lib.fitting.families import FAMILIES
from neuma_lib.io.images import write_transforms
from neuma_lib.mechanics.neural import neural_law
from tests.support.errors import refused
from tests.support.grounding_scene import HEIGHT, MODEL, ball, camera, observe
from tests.support.viewer_project import STEPS, make_project

pytestmark = pytest.mark.core

ROOT = Path(__file__).resolve().parents[1]
V0 = (0.5, -1.5, 0.0)
SOFT = {"elasticity": {"name": "hencky", "E": 1.5e4, "nu": 0.35}}
FRAMES = tuple(range(0, 121, 8))


def moving(v0=V0) -> nm.InitialMotion:
    return nm.InitialMotion(np.array(v0), np.zeros(3), np.array([0.5, HEIGHT, 0.5]), np.eye(3), np.zeros(6))


@pytest.fixture(scope="module")
def scene() -> nm.Scene:
    """A soft ball that falls on the floor, filmed by one camera, with its true motion."""
    body = ball(dtype=torch.float32)
    video = nm.Video((observe(body, V0, FRAMES, SOFT, size=24),))
    motion = moving()
    truth = nm.simulate(MODEL, nm.Law.from_spec(SOFT), motion.of_body(body), FRAMES, tracers=body.x0[:50])
    return nm.Scene(MODEL, body, video, motion, truth)


def test_the_example_of_the_readme_runs(capsys):
    (code,) = re.findall(r"```python\n(.*?)```", (ROOT / "README.md").read_text(), re.DOTALL)
    names = {}
    torch.manual_seed(0)
    exec(code, names)
    assert "torch.Size([21, 2000, 3])" in capsys.readouterr().out
    gradient, start = names["v"].grad, names["state"]
    assert gradient.isfinite().all()
    heights = []
    for change in (0.01, -0.01):  # many particles start contact within it: the mean slope of many pieces
        moved = replace(start, v=torch.tensor([0.0, -1.0 + change, 0.0]))
        path = nm.simulate(nm.MPM(grid=24, dt=1e-3), names["law"], moved, frames=[200])
        heights.append(float(path.x[-1, :, 1].mean()))
    assert gradient[1] == pytest.approx((heights[0] - heights[1]) / 0.02, rel=0.05)


def test_a_simulation_ends_at_its_last_frame(scene):
    law, start = nm.Law.from_spec(SOFT), scene.state()
    path = nm.simulate(scene.mpm, law, start, [0, 8], total=True)
    whole = nm.rollout(scene.mpm, law, start, steps=8, frames=(0, 8), total=True)
    assert path.frames == (0, 8) and torch.equal(path.x, whole.x) and torch.equal(path.F_total, whole.F_total)
    with refused("frames"):
        nm.simulate(scene.mpm, law, start, [])


def test_a_law_is_the_same_after_it_was_written(tmp_path):
    F = torch.eye(3) + 0.1 * torch.randn(20, 3, 3, generator=torch.Generator().manual_seed(0))
    for law, about in ((nm.Law.from_spec(SOFT), {}), (neural_law(seed=1), {"dt": 1e-3})):
        law.save(tmp_path / "law.safetensors", about)
        again = nm.Law.load(tmp_path / "law.safetensors")
        assert torch.equal(law.elasticity(F), again.elasticity(F))
    with refused("elasticity.name"):
        nm.Law.from_spec({"elasticity": {"name": "jelly"}})


def test_the_motion_is_estimated_from_the_frames_before_contact(scene):
    motion = nm.estimate_motion(scene.reconstruction, scene.video, scene.mpm)
    assert np.abs(motion.velocity[:2] - V0[:2]).max() < 0.05
    assert (motion.std[:3] > 0).all()


def test_a_material_is_identified(scene):
    families = {"hencky": {"elasticity": {"name": "hencky", "E": 3e4, "nu": 0.3}}}
    options = {"pyramid": (8, 24), "iterations": 4, "covariance_from": "elastic", "gaussian_motion": "mean"}
    material = nm.identify(scene, families, options)
    assert material.family == "hencky" and material.ties == () and set(material.std) == {"E", "nu"}
    assert material.contact_friction == {}
    low, high = material.interval("E", 0.8)
    assert low < material.constants["E"] < high and material.interval("E", 0.95)[1] > high
    assert {"G", "K"} <= set(material.quantities) and material.probabilities == {"hencky": 1.0}
    assert material.constants["E"] == pytest.approx(1.5e4, rel=0.1)
    assert float(material.law.elasticity.values["E"]) == material.constants["E"]
    with refused("options.particles"):
        nm.identify(scene, families, {"particles": 100})


def test_friction_is_identified_next_to_the_constants(scene):
    """A ball that slides before it rolls, in a video without noise."""
    rough = replace(MODEL, contact="particles")
    body = scene.reconstruction
    video = nm.Video((observe(body, V0, FRAMES, SOFT, size=24, model=rough.with_friction(0.2)),))
    families = {"hencky": {"elasticity": {"name": "hencky", "E": 3e4, "nu": 0.3}}}
    options = {"pyramid": (8, 24), "covariance_from": "elastic", "gaussian_motion": "mean"}
    slippery = nm.Scene(rough, body, video, scene.motion)
    material = nm.identify(slippery, families, {**options, "contact_friction": "fitted"})
    assert set(material.constants) == set(material.std) == {"E", "nu"}
    assert material.contact_friction["value"] == pytest.approx(0.2, rel=0.1)
    assert material.contact_friction["log_std"] < 0.5


def test_the_default_families_are_those_of_the_shipped_settings():
    shipped = yaml.safe_load((ROOT / "config/config.yaml").read_text())["identify"]["families"]
    assert shipped == FAMILIES and list(shipped) == list(FAMILIES)


@pytest.mark.parametrize("analytic", [False, True])
def test_a_law_is_adapted_to_a_video(scene, analytic):
    """A neural law gets an adaptor, an analytic one a structured correction; the given law does not change."""
    if analytic:
        law = nm.Law.from_spec({"elasticity": {"name": "hencky", "E": 3e4, "nu": 0.35}})
        options = {"iterations": 2, "trial_iterations": 2, "covariance_from": "elastic"}
    else:
        law, options = neural_law(seed=0), {"rank": 4, "iterations": 3}
    before = {key: value.clone() for key, value in law.state_dict().items()}
    adaptation = nm.adapt(law, scene, options)
    assert adaptation.stable and adaptation.law is not law
    assert all(torch.equal(value, before[key]) for key, value in law.state_dict().items())
    assert min(adaptation.loss) <= adaptation.loss[0]
    assert (adaptation.parts is not None) == analytic


def test_options_that_the_scene_determines_are_refused(scene):
    with refused("options.views"):
        nm.adapt(neural_law(seed=0), scene, {"views": (1,)})
    with refused("scene.video"):
        nm.adapt(neural_law(seed=0), replace(scene, video=None))


def test_a_law_is_not_adapted_to_free_flight(scene):
    (video,) = scene.video.observations
    first = nm.Video((replace(video, frames=video.frames[:2], images=video.images[:2]),))
    with refused("frames", problem="touches nothing"):
        nm.adapt(neural_law(seed=0), replace(scene, video=first))


def test_a_motion_is_rendered(scene):
    images = nm.render(scene.truth, scene.reconstruction, scene.video.cameras)
    assert images.shape == (len(FRAMES), 1, 24, 24, 4)
    assert torch.allclose(images[..., :3], scene.video.observations[0].images, atol=1e-5)
    coverage = images[..., 3]
    assert coverage.min() >= 0 and 0.5 < coverage.max() <= 1
    with refused("path"):
        nm.render(scene.truth, ball(count=200, dtype=torch.float32), camera(dtype=torch.float32))


def test_a_prediction_is_compared_with_the_truth(scene):
    same = nm.evaluate(scene.truth, scene.truth)
    assert same["tracer_rmse_mm"] == 0 and same["chamfer"] == 0
    shifted = replace(scene.truth, tracers=scene.truth.tracers + torch.tensor([0.003, 0.0, 0.004]))
    assert nm.evaluate(shifted.at((0, 8)), scene.truth)["tracer_rmse_mm"] == pytest.approx(5, rel=1e-3)
    assert "tracer_rmse_mm" not in nm.evaluate(replace(scene.truth, tracers=None), scene.truth)
    with refused("path.frames"):
        nm.evaluate(replace(scene.truth, frames=tuple(n + 1 for n in FRAMES)), scene.truth)


def test_a_scene_is_read_from_a_folder_of_results(tmp_path, capsys):
    folder = make_project(tmp_path)
    scene = nm.Scene.load(folder)
    assert scene.mpm.dt > 0 and scene.video.frames == STEPS and scene.truth.frames == STEPS
    assert (scene.motion.velocity == 0).all() and len(scene.state().x) == len(scene.reconstruction.x0)
    path = nm.simulate(scene.mpm, nm.Law.from_spec(SOFT), scene.state(), [0])
    images = nm.render(path, scene.reconstruction, scene.video.cameras)
    assert images.shape == (1, 1, 24, 32, 4)
    with refused(tmp_path / "missing"):
        nm.Scene.load(tmp_path / "missing")
    pytest.importorskip("matplotlib")  # the colours of the viewer's page
    nm.view(folder, file=tmp_path / "scene.html")
    assert (tmp_path / "scene.html").is_file() and "motions" in capsys.readouterr().out


def test_a_body_is_reconstructed_from_images(tmp_path):
    """A grey ball of radius 0.1 m before a white background, seen from 12 sides."""
    radius, size, focal = 0.1, 48, 60.0
    v, u = np.mgrid[:size, :size] + 0.5
    directions = np.stack([(u - size / 2) / focal, -(v - size / 2) / focal, -np.ones_like(u)], -1)
    directions /= np.linalg.norm(directions, axis=-1, keepdims=True)
    frames = []
    for k in range(12):
        around, up = 2 * np.pi * k / 12, 0.5 * (-1) ** k
        back = np.array([np.cos(up) * np.sin(around), np.sin(up), np.cos(up) * np.cos(around)])
        right = np.cross([0.0, 1.0, 0.0], back)
        right /= np.linalg.norm(right)
        pose = np.eye(4)
        pose[:3, :3] = np.stack([right, np.cross(back, right), back], axis=1)
        pose[:3, 3] = 0.5 + 0.6 * back
        miss = 0.6 * np.sqrt(1 - directions[..., 2] ** 2)
        rgba = np.full((size, size, 4), 120, np.uint8)
        rgba[..., 3] = np.where(miss < radius, 255, 0)
        Image.fromarray(rgba).save(tmp_path / f"s_{k}.png")
        frames.append({"file_path": f"s_{k}.png", "transform_matrix": pose.tolist()})
    intrinsics = {"w": size, "h": size, "fl_x": focal, "fl_y": focal, "cx": size / 2, "cy": size / 2}
    write_transforms(tmp_path / "transforms.json", intrinsics, frames)
    gaussians, surface = {"iterations": 30, "initial_count": 150}, {"resolution": 24}
    options = {"particles": 300, "gaussians": gaussians, "surface": surface}
    body = nm.Reconstruction.from_images(tmp_path / "transforms.json", 1000.0, options)
    assert float(body.mass.sum()) == pytest.approx(1000 * 4 / 3 * np.pi * radius**3, rel=0.15)
    centre = body.mass @ body.x0 / body.mass.sum()
    assert (centre - 0.5).abs().max() < 0.01
    with refused("options.grid"):
        nm.Reconstruction.from_images(tmp_path / "transforms.json", 1000.0, {"grid": 3})


def test_methods_are_listed_by_name():
    assert {"neuma", "constants", "structured"} <= set(nm.METHODS)
    assert all(isinstance(method, nm.Method) and method.name == name for name, method in nm.METHODS.items())
