"""Datasets of images that the user supplies, and truths that are simulated in other ways, made by one run."""

import numpy as np
import pytest

from neuma_lib.io.hdf5 import read_arrays
from neuma_lib.io.images import read_image_set
from tests.support.errors import refused
from tests.support.image_layouts import WRITERS, centre_of, ours
from tests.support.project import Plan, copied, overlay
from tests.support.released_images import write_release
from workflow.inputs import image_list

# tiny.yaml's truth has 14 nodes, a step of 2e-3 s and 800 particles.
TRUTHS = {
    "Default": {},
    "Same": {"grid": 14, "dt": 2.0e-3},
    "Refined": {"grid": 28, "dt": 1.0e-3, "particles": 3000},
}


def transforms(scene):
    return [f"tiny/data/{scene}/{kind}/transforms.json" for kind in ("static", "dynamic")]


@pytest.fixture(scope="module")
def supplied(tmp_path_factory, kernels):
    """A copy with all data: of a list of images, of folders of other systems, and of the three truths."""
    project = copied(tmp_path_factory.mktemp("datasets") / "project", kernels)
    lists = {kind: str(write_release(project.root / kind, kind=kind)) for kind in ("static", "dynamic")}
    scenes = {"Released": {"images": lists}}
    for layout, write in WRITERS.items():
        folder = write(project.root / layout, cameras=4, frames=5)[0].parent
        images = {"static": layout, "dynamic": layout, "stride": 10}
        assert folder.name == layout
        scenes[layout] = {"like": "ClayCat", "dt": 0.002, "steps": 40, "images": images}
    scenes |= {name: {"truth": truth} for name, truth in TRUTHS.items()}
    scenes = {name: {"like": "BouncyBall", **scene} for name, scene in scenes.items()}
    settings = overlay(scenes=scenes, dataset={"blender": {"device": "auto"}}, device="cpu")
    targets = [file for name in ("Released", *WRITERS) for file in transforms(name)]
    targets += [f"tiny/data/{name}/truth.h5" for name in TRUTHS]
    others = [f"tiny/results/{layout}/neuma/metrics.json" for layout in WRITERS]
    others.append("tiny/data/ClayCat/static/transforms.json")
    project.lists, project.output = lists, project.run(*settings, *targets)
    project.ran, project.planned = Plan.of(project.output), project.plan(*settings, *others)
    return project


def test_workflow_takes_supplied_images_in_place_of_blenders(supplied):
    targets = transforms("Released")
    assert supplied.ran.behind(*targets) == {"supplied_static": 1, "supplied_dynamic": 1}
    assert "6 images of 32x30 px, 2 views" in supplied.output
    for images, target in zip(supplied.lists.values(), targets, strict=True):
        ours, theirs = read_image_set(supplied.root / target), read_image_set(images)
        assert (ours.images == theirs.images).all() and (ours.viewmats == theirs.viewmats).all()


def test_images_of_other_scenes_are_rendered_on_one_core(supplied):
    others = supplied.planned.behind(*transforms("ClayCat")[:1])
    assert others["render_static"] == 1 and "supplied_static" not in others
    resources = others.one("render_static").text
    assert "gpu=0" in resources and "threads: 2" not in resources


@pytest.mark.parametrize("layout", WRITERS)
def test_a_scene_is_made_of_another_systems_folder(supplied, layout):
    """Named by its folder, without Blender; the rest of the plan is that of any scene."""
    assert supplied.ran.behind(*transforms(layout)) == {"supplied_static": 1, "supplied_dynamic": 1}
    plan = supplied.planned.behind(f"tiny/results/{layout}/neuma/metrics.json")
    assert plan["fit_neuma"] == plan["ground_truth"] == 1
    assert not any(rule.startswith("render") for rule in plan)
    output = "\n".join(line for line in supplied.output.splitlines() if f" {layout}: " in line)
    assert "20 images of 40x36 px, 4 views" in output and "a frame every 0.02 s" in output
    static, video = (read_image_set(supplied.root / file) for file in transforms(layout))
    assert (static.images == video.images[:4]).all() and np.unique(video.steps).tolist() == [
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


def test_frames_that_a_layout_counts_need_a_stride(supplied):
    scene, *others = WRITERS
    images = {"static": scene, "dynamic": scene}
    settings = overlay(scenes={"Theirs": {"like": "ClayCat", "dt": 0.002, "images": images}})
    output = supplied.run("--dry-run", *settings, transforms("Theirs")[1], succeeds=False)
    assert "scenes.Theirs.images.stride" in output
    for layout in others:
        with refused("scenes.Theirs.images.stride"):
            image_list(str(supplied.root / layout), None, "images", "scenes.Theirs.images.stride")


def test_a_refined_truth_has_the_same_frames_and_an_equal_one_the_same_bytes(supplied):
    files = [supplied.root / f"tiny/data/{name}/truth.h5" for name in TRUTHS]
    default, same, _ = (file.read_bytes() for file in files)
    assert default == same
    (arrays, attributes), _, (refined, others) = map(read_arrays, files)
    assert (refined["frames"] == arrays["frames"]).all() and (refined["time"] == arrays["time"]).all()
    assert others["dt"] == attributes["dt"] and refined["x"].shape[1] > 3 * arrays["x"].shape[1]
    # Before contact both fall alike; v follows gravity exactly at each step, x lags by at most g t dt / 2.
    fall = [a["tracers"].mean(axis=1)[:4] for a in (arrays, refined)]
    assert abs(fall[0] - fall[1]).max() < 9.8 * arrays["time"][3] * 1e-3 / 2 + 1e-5
    assert abs(fall[0] - fall[1]).max() > 0
