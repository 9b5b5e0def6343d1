"""Datasets of images that the user supplies."""

import numpy as np
import pytest
import yaml

from neuma_lib.io.hdf5 import read_arrays
from neuma_lib.io.images import read_image_set
from tests.support.image_layouts import WRITERS, centre_of, ours
from tests.support.project import copied
from tests.support.released_images import write_release


def test_workflow_takes_supplied_images_in_place_of_blenders(tmp_path):
    project = copied(tmp_path / "project", tmp_path / "kernels")
    images = {kind: str(write_release(tmp_path / kind, kind=kind)) for kind in ("static", "dynamic")}
    settings = yaml.safe_load((project.root / "tests/workflow/tiny.yaml").read_text())
    settings["scenes"]["BouncyBall"]["images"] = images
    (project.root / "tests/workflow/tiny.yaml").write_text(yaml.safe_dump(settings))
    targets = [f"tiny/data/BouncyBall/{kind}/transforms.json" for kind in images]
    assert project.plan(f"{targets[0]}") == {"supplied_static": 1}
    output = project.run(*targets)
    assert "6 images of 32x30 px, 2 views" in output
    for kind, target in zip(images, targets, strict=True):
        ours, theirs = read_image_set(project.root / target), read_image_set(images[kind])
        assert (ours.images == theirs.images).all() and (ours.viewmats == theirs.viewmats).all()
    others = project.plan("tiny/data/ClayCat/static/transforms.json")
    assert others["render_static"] == 1 and "supplied_static" not in others


@pytest.mark.parametrize("layout", WRITERS)
def test_a_scene_is_made_of_another_systems_folder(tmp_path, layout):
    """Named by its folder, without Blender; the rest of the plan is that of any scene."""
    project = copied(tmp_path / "project", tmp_path / "kernels")
    folder = WRITERS[layout](project.root / "theirs", cameras=4, frames=5)[0].parent
    settings = yaml.safe_load((project.root / "tests/workflow/tiny.yaml").read_text())
    images = {"static": folder.name, "dynamic": folder.name}
    settings["scenes"]["Theirs"] = {
        "like": "BouncyBall",
        "dt": 0.002,
        "steps": 40,
        "frames": None,
        "images": images,
    }
    own = project.root / "tests/workflow/tiny.yaml"
    own.write_text(yaml.safe_dump(settings))
    said = project.run("--dry-run", "tiny/data/Theirs/dynamic/transforms.json", succeeds=False)
    assert "scenes.Theirs.images.stride" in said
    images["stride"] = 10
    own.write_text(yaml.safe_dump(settings))
    plan = project.plan("tiny/results/Theirs/neuma/metrics.json")
    assert (
        plan["supplied_static"] == plan["supplied_dynamic"] == plan["fit_neuma"] == plan["ground_truth"] == 1
    )
    assert not any(rule.startswith("render") for rule in plan)
    output = project.run(*(f"tiny/data/Theirs/{kind}/transforms.json" for kind in images if kind != "stride"))
    assert "20 images of 40x36 px, 4 views" in output and "a frame every 0.02 s" in output
    static = read_image_set(project.root / "tiny/data/Theirs/static/transforms.json")
    video = read_image_set(project.root / "tiny/data/Theirs/dynamic/transforms.json")
    assert (static.images == video.images[:4]).all() and sorted(set(video.steps.tolist())) == [
        0,
        10,
        20,
        30,
        40,
    ]
    # The rays through the middle of the masks meet where the body is.
    normals, offsets = [], []
    for image, viewmat, K in zip(static.images, static.viewmats, static.Ks, strict=True):
        v, u = np.argwhere(image[..., 3] > 0).mean(axis=0) + 0.5
        ray = viewmat[:3, :3].T @ np.linalg.solve(K, [u, v, 1.0])
        across = np.eye(3) - np.outer(ray, ray) / (ray @ ray)
        normals.append(across)
        offsets.append(across @ (-viewmat[:3, :3].T @ viewmat[:3, 3]))
    middle = np.linalg.solve(sum(normals), sum(offsets))
    assert abs(middle - ours(layout, centre_of(layout, 0))).max() < 0.01


def test_a_finer_truth_has_the_same_frames_and_one_as_fine_the_same_bytes(kernels, tmp_path):
    """tiny.yaml's truth has 14 nodes, a step of 2e-3 s and 800 particles."""
    project = copied(tmp_path / "project", kernels)
    file = project.root / "tiny/data/BouncyBall/truth.h5"

    def truth(settings):
        own = f"scenes={{BouncyBall: {{truth: {{{settings}}}}}}}"
        project.run("--config", own, "--", "tiny/data/BouncyBall/truth.h5")
        return file.read_bytes(), read_arrays(file)

    plain, (arrays, attributes) = truth("")
    assert truth("grid: 14, dt: 2.0e-3")[0] == plain
    _, (finer, said) = truth("grid: 28, dt: 1.0e-3, particles: 3000")
    assert (finer["frames"] == arrays["frames"]).all() and (finer["time"] == arrays["time"]).all()
    assert said["dt"] == attributes["dt"] and finer["x"].shape[1] > 3 * arrays["x"].shape[1]
    # Before contact both fall alike; v follows gravity exactly at each step, x lags by at most g t dt / 2.
    fall = [a["tracers"].mean(axis=1)[:4] for a in (arrays, finer)]
    assert abs(fall[0] - fall[1]).max() < 9.8 * arrays["time"][3] * 1e-3 / 2 + 1e-5
    assert abs(fall[0] - fall[1]).max() > 0
