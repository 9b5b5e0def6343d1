"""A capture of two bodies with labelled masks, from drawn photographs and videos to their joint identification."""

import json
import shutil

import numpy as np
import pytest
import torch
from PIL import Image
from scipy.spatial.transform import Rotation

from neuma_lib.evaluation.material_point import Visited
from neuma_lib.io.files import read_json
from neuma_lib.io.hdf5 import read_arrays
from neuma_lib.io.images import read_labels
from neuma_lib.io.mesh import read_mesh
from tests.support.board_pictures import LENS, around, looking_at
from tests.support.drawn_board import Eye, Solid, write_video
from tests.support.full_run import write_lpips
from tests.support.project import copied, overlay

SETTINGS = """\
board: {square: 0.03}
poses: board
lens: lenses.json
duration: 0.2
scale: 2.0
advanced: {longest: 400}
bodies:
  clay: {label: 40, density: 1500}
  gum: {label: 200}
"""
MIDDLE = np.array([0.09, 0.12, 0.0])
RADII = {"clay": np.array([0.045, 0.035, 0.04]), "gum": np.array([0.03, 0.04, 0.035])}
COLOURS = {"clay": (205, 95, 50), "gum": (60, 120, 190)}
PHOTOGRAPHED = {"clay": MIDDLE + (-0.045, 0.0, 0.04), "gum": MIDDLE + (0.03, 0.0, 0.035)}  # they touch
RELEASED = {"clay": MIDDLE + (-0.05, 0.01, 0.24), "gum": MIDDLE + (0.05, 0.0, 0.30)}
VELOCITY = {"clay": np.array([-0.05, -0.1, 0.0]), "gum": np.array([0.05, 0.05, 0.1])}
LABELS = np.array([0, 40, 200], np.uint8)
RATE, COUNT, GRAVITY = 120, 30, np.array([0.0, 0.0, -9.81])
PILE, TAKE = "tiny/results/pile", "tiny/results/pile_first"


def solids(t):
    """Both bodies in free fall, turning, until each is on the floor, where it stays."""
    drawn = []
    for name, radii in RADII.items():
        late = np.sqrt(2 * (RELEASED[name][2] - radii[2]) / 9.81)
        s = min(t, late)
        place = RELEASED[name] + VELOCITY[name] * s + GRAVITY * s * s / 2
        drawn.append(Solid(place, Rotation.from_rotvec([s, 2 * s, 0.5]), radii, COLOURS[name]))
    return drawn


@pytest.fixture(scope="module")
def drawn(tmp_path_factory):
    """Photographs of the bodies side by side, stills, videos of two cameras, and label images of all."""
    pytest.importorskip("cv2")
    root = tmp_path_factory.mktemp("drawn")
    for name in ("photos", "stills", "videos", "masks/photographs", "masks/first/left", "masks/first/right"):
        (root / name).mkdir(parents=True)
    resting = [
        Solid(place, Rotation.identity(), RADII[name], COLOURS[name]) for name, place in PHOTOGRAPHED.items()
    ]
    for k, pose in enumerate([*around(8), *around(6, radius=0.35, height=0.55)]):
        seen, numbers = Eye(pose).see(*resting)
        Image.fromarray(seen).save(root / f"photos/{k}.png")
        Image.fromarray(LABELS[numbers]).save(root / f"masks/photographs/{k}.png")
    for name, angle in (("left", 0.4), ("right", 1.9)):
        at = MIDDLE + (0.6 * np.cos(angle), 0.6 * np.sin(angle), 0.4)
        eye = Eye(looking_at(at, MIDDLE + (0, 0, 0.1)))
        Image.fromarray(eye.empty).save(root / f"stills/{name}.png")
        frames = [eye.see(*solids(k / RATE)) for k in range(COUNT)]
        write_video(root / f"videos/{name}.mp4", [seen for seen, _ in frames])
        for k, (_, numbers) in enumerate(frames):
            Image.fromarray(LABELS[numbers]).save(root / f"masks/first/{name}/{k}.png")
    lenses = dict.fromkeys(("photographs", "left", "right"), LENS.plain())
    (root / "lenses.json").write_text(json.dumps(lenses))
    (root / "capture.yaml").write_text(SETTINGS)
    return root


@pytest.fixture
def project(tmp_path, kernels, drawn):
    made = copied(tmp_path / "project", kernels)
    shutil.copytree(drawn, made.root / "captures/pile")
    return made


def test_labelled_bodies_enter_the_rules_of_several_bodies(project):
    plan = project.plan(f"{PILE}/constants/report.html")
    counts = {"capture_photograph_masks": 1, "gaussians_of_bodies": 1, "capture_video_masks": 6}
    counts |= {rule: 2 for rule in ("body_gaussians", "body_static", "mesh", "binding")}
    counts |= {"capture_flight": 2, "capture_registration": 2, "capture_video": 1, "identify_bodies": 1}
    counts |= {"experiment_start": 1, "predict": 2, "capture_view": 4}  # with the prior
    counts |= {"capture_display": 1, "capture_curves": 1}
    assert {rule: plan[rule] for rule in counts} == counts
    assert plan["capture_poses"] == plan["capture_room"] == 1 and not plan["velocity_of_bodies"]


def test_a_body_may_be_photographed_in_another_capture(project):
    captures = project.root / "captures"
    shutil.copytree(captures / "pile", captures / "gum", ignore=shutil.ignore_patterns("videos", "stills"))
    single = "board: {square: 0.03}\nposes: board\nlens: lenses.json\n"
    (captures / "gum/capture.yaml").write_text(single + "scale: 2.0\n")
    both = SETTINGS.replace("label: 200", "label: 200, capture: gum")
    (captures / "pile/capture.yaml").write_text(both)
    target = f"{TAKE}/identified.json"
    plan = project.plan(target)
    assert plan["gaussians"] == plan["body_gaussians"] == 1 and plan["capture_photograph_masks"] == 2
    sources = [{*job.inputs} for job in plan.of_rule("capture_registration")]
    for name in (f"{PILE}_clay", "tiny/results/gum"):
        assert sum(f"{name}/gaussians.ply" in inputs for inputs in sources) == 1
    (captures / "gum/capture.yaml").write_text(single)
    assert "the scale of 'gum' is 1, but 2 here" in project.run("--dry-run", target, succeeds=False)
    (captures / "pile/capture.yaml").write_text(both.replace("capture: gum", "capture: cup"))
    output = project.run("--dry-run", target, succeeds=False)
    assert "bodies.gum.capture: no capture 'cup' of one body" in output


def world(points):
    """From the board's frame to the simulator's box, y up, with the board's middle at its middle."""
    x, y, z = np.moveaxis(np.asarray(points) - MIDDLE, -1, 0)
    return 2.0 * np.stack([x, z, -y], axis=-1) + (0.5, 0.0, 0.5)


@pytest.mark.slow
def test_drawn_bodies_are_reconstructed_placed_and_identified(project):
    """The bodies touch in the photographs. One hides half of the other from one camera in flight."""
    identify = {"families": {"soft": {"elasticity": {"name": "neo_hookean", "E": 1e5, "nu": 0.3}}}}
    gaussians = {"iterations": 300, "initial_count": 600, "hull_resolution": 32}
    changes = overlay(identify=identify, gaussians=gaussians, viewer={"methods": ["constants"]})
    videos = [f"tiny/data/pile_first{part}/dynamic/transforms.json" for part in ("", "_clay", "_gum")]
    write_lpips(project)
    report = f"{PILE}/constants/report.html"
    project.run(*changes, f"{TAKE}/viewer.html", f"{PILE}/motion.md", report, *videos)
    root = project.root
    for name, radii in RADII.items():
        mesh = read_mesh(root / f"{PILE}_{name}/mesh.ply")
        assert mesh.volume == pytest.approx(8 * 4 / 3 * np.pi * radii.prod(), rel=0.03)
        np.testing.assert_allclose(mesh.bounds.mean(axis=0), world(PHOTOGRAPHED[name]), atol=0.006)
        placed, motion = (
            read_json(root / f"{TAKE}_{name}/{file}.json") for file in ("registration", "velocity")
        )
        assert placed["t0_s"] == pytest.approx(0, abs=1e-3)
        assert min(view["iou"] for view in placed["after"].values()) > 0.94
        np.testing.assert_allclose(motion["centre"], world(RELEASED[name]), atol=0.004)
        true = 2.0 * VELOCITY[name][[0, 2, 1]] * (1, 1, -1)
        np.testing.assert_allclose(motion["v0"], true, atol=0.02)
    whole, *parts = (read_json(root / file) for file in videos)
    labels = read_labels(root / videos[0])
    assert len(labels) == len(whole["frames"]) and {*np.unique(labels)} == {0, 1, 2}
    assert [part["body"] for part in parts] == [1, 2]
    page = (root / PILE / "motion.md").read_text()
    assert "flight in first, clay" in page and "(../pile_gum/flight/first.png)" in page
    identified = read_json(root / f"{TAKE}/identified.json")
    assert list(identified["bodies"]) == ["clay", "gum"]
    (pair,) = identified["pairs"]
    assert pair["log_std"] > 1  # they do not touch
    assert read_json(root / f"{TAKE}/constants/prediction.json")["stable"]
    names = (root / TAKE / "viewer.html").read_text()
    assert '"clay"' in names and '"gum"' in names
    assert identified["hidden"]["clay"][0] > 0.1 > identified["hidden"]["gum"][0]
    text = (root / report).read_text()
    for part in (
        "clay: identified family: soft",
        "clay and gum",
        "Free flight: first, gum",
        "1500 (clay), 1000 (gum)",
    ):
        assert part in text
    curves = read_json(root / f"{PILE}/constants/stress_curves.json")["bodies"]
    F = torch.from_numpy(read_arrays(root / f"{TAKE}/constants/rollout.h5")[0]["F"])
    counts = [each["particles"] for each in identified["start"]["bodies"]]
    for name, own in zip(("clay", "gum"), F.split(counts, dim=1), strict=True):
        tests = curves[name]["tests"]
        assert all(test["laws"]["constants"]["band"] for test in tests.values())
        assert tests["shear"]["visited"] == pytest.approx(Visited.of(own).shear)
    assert all(f"rgb({colour})" in text for colour in ("90%, 62%, 0%", "34%, 71%, 91%"))
    assert "no stress curves" not in text
    assert "The video of" not in text and "picture is missing" not in text
    assert "The density of gum is the default" in text
    for camera in ("left", "right"):
        assert read_json(root / f"{TAKE}/constants/views/{camera}.json")["mean"]["iou"] > 0.8
    for file in (root / "captures/pile/masks/first/left").iterdir():
        pixels = np.asarray(Image.open(file))
        Image.fromarray(np.where(pixels == 200, 40, pixels).astype(np.uint8)).save(file)
    output = project.run(*changes, f"{PILE}_gum/masks/first/left.json", succeeds=False)
    assert "no mask has the label 200 of gum" in output and "Traceback" not in output
