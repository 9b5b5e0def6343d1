"""A capture of two bodies with labelled masks, from drawn photographs and videos to their joint identification."""

import json
import shutil

import numpy as np
import pytest
from PIL import Image
from scipy.spatial.transform import Rotation

from neuma_lib.io.files import read_json
from neuma_lib.io.images import read_labels
from neuma_lib.io.mesh import read_mesh
from tests.support.board_pictures import LENS, around, looking_at
from tests.support.drawn_board import Eye, Solid, write_video
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
    plan = project.plan(f"{TAKE}/identified.json")
    counts = {"capture_photograph_masks": 1, "gaussians_of_bodies": 1, "capture_video_masks": 6}
    counts |= {rule: 2 for rule in ("body_gaussians", "body_static", "mesh", "binding")}
    counts |= {"capture_flight": 2, "capture_registration": 2, "capture_video": 1, "identify_bodies": 1}
    assert {rule: plan[rule] for rule in counts} == counts
    assert plan["capture_poses"] == plan["capture_room"] == 1 and not plan["velocity_of_bodies"]


def world(points):
    """From the board's frame to the simulator's box, y up, with the board's middle at its middle."""
    x, y, z = np.moveaxis(np.asarray(points) - MIDDLE, -1, 0)
    return 2.0 * np.stack([x, z, -y], axis=-1) + (0.5, 0.0, 0.5)


@pytest.mark.slow
def test_drawn_bodies_are_reconstructed_placed_and_identified(project):
    identify = {"families": {"soft": {"elasticity": {"name": "neo_hookean", "E": 1e5, "nu": 0.3}}}}
    gaussians = {"iterations": 300, "initial_count": 600, "hull_resolution": 32}
    project.run(*overlay(identify=identify, gaussians=gaussians), f"{TAKE}/identified.json")
    root = project.root
    for name, radii in RADII.items():
        mesh = read_mesh(root / f"{PILE}_{name}/mesh.ply")
        print(
            name,
            mesh.volume / (8 * 4 / 3 * np.pi * radii.prod()),
            mesh.bounds.mean(axis=0) - world(PHOTOGRAPHED[name]),
        )
        placed = read_json(root / f"{TAKE}_{name}/registration.json")
        motion = read_json(root / f"{TAKE}_{name}/velocity.json")
        t = placed["t0_s"]
        true = RELEASED[name] + VELOCITY[name] * t + GRAVITY * t * t / 2
        print(
            placed["t0_s"],
            np.subtract(motion["centre"], world(true)),
            np.subtract(motion["v0"], 2 * (VELOCITY[name] + GRAVITY * t)[[0, 2, 1]] * (1, 1, -1)),
            placed["after"],
        )
    dynamic = root / "tiny/data/pile_first/dynamic/transforms.json"
    labels = read_labels(dynamic)
    print(labels.shape, np.bincount(labels.ravel()))
    print(read_json(root / f"{TAKE}/identified.json")["pairs"])
