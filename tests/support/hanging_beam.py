"""The experiment of docs/results/silicone.md with a known beam: same size, camera and clamp."""

import json
from dataclasses import replace

import numpy as np
import trimesh
from PIL import Image
from scipy.spatial.transform import Rotation

from neuma_lib.data.blender.scene import Surface, render_images
from neuma_lib.fitting.resting import UNKNOWNS, RestingBody, StillResiduals
from neuma_lib.geometry.blocks import hexahedra
from neuma_lib.geometry.obstacles import Obstacle
from neuma_lib.geometry.outline import silhouette
from neuma_lib.io.datasets.stills import Still
from neuma_lib.mechanics.law import Law
from neuma_lib.sim.clamps import Clamp
from neuma_lib.splatting.viewpoints import Views

CLAMP, HIDDEN, PLACEMENT = 0.07, 0.05, np.array([-0.09, -0.036, -0.016])
K = np.array([[903.7, 0.0, 640.0], [0.0, 903.7, 360.0], [0.0, 0.0, 1.0]])
WIDTH, HEIGHT, MARKER = 1280, 720, 0.01 * np.array([[-1, 1, 0], [1, 1, 0], [1, -1, 0], [-1, -1, 0]])
POSE = np.eye(4)
POSE[:3, :3] = Rotation.from_euler("yxz", [24.0, 172.0, 2.0], degrees=True).as_matrix()
POSE[:3, 3] = 0.07, -0.01, 0.52


def dumbbell():
    """Surface of three blocks on one axis, 20 x 6 x 3 cm."""
    x, y = np.array([-0.1, -0.07, 0.07, 0.1]), np.array([-0.03, -0.015, 0.015, 0.03])
    outline = [(0, 0), (1, 0), (1, 1), (2, 1), (2, 0), (3, 0), (3, 3), (2, 3), (2, 2), (1, 2), (1, 3), (0, 3)]
    ring = np.array([(x[i], y[j]) for i, j in outline])
    bottom, top = (np.column_stack([ring, np.full(12, z)]) for z in (-0.015, 0.015))
    blocks = [(0, 1, 2, 9, 10, 11), (2, 3, 8, 9), (3, 4, 5, 6, 7, 8)]
    caps = np.array([(b[0], b[i], b[i + 1]) for b in blocks for i in range(1, len(b) - 1)])
    sides = np.array([(i, (i + 1) % 12, (i + 1) % 12 + 12, i + 12) for i in range(12)])
    faces = [caps[:, ::-1], caps + 12, sides[:, [0, 1, 2]], sides[:, [0, 2, 3]]]
    return trimesh.Trimesh(np.concatenate([bottom, top]), np.concatenate(faces), process=False)


HELD = np.array([[-0.11, -0.04, -0.1], [-0.084, -0.014, 0.1]])
"""Lower edge of the free end, where a line holds the beam before a release."""


def law_spec(nu=0.49):
    """Its law, with mu = 100 Pa."""
    return {"elasticity": {"name": "neo_hookean", "E": 200.0 * (1 + nu), "nu": nu}}


def resting_beam(size, clamp=CLAMP, nu=0.49, held=None):
    """The beam with elements of a size [m], clamped from x = clamp on."""
    clamped = Clamp((clamp, -1.0, -1.0), (1.0, 1.0, 1.0))
    mesh, law = hexahedra(dumbbell(), size, [clamped.lowest]), Law.from_spec(law_spec(nu))
    hidden = np.array([[HIDDEN, -1, -1], [1, 1, 1]])
    return RestingBody(mesh, law, 100.0, [clamped], np.eye(3), hidden, 0.005, held)


def observe(mask, seed=1, noise=0.5):
    """A still of a mask, with corners of the marker that have an error [px]."""
    local = MARKER @ POSE[:3, :3].T + POSE[:3, 3]
    pixels = local @ K.T
    error = np.random.default_rng(seed).normal(0, noise, (4, 2))
    return Still(mask, K, MARKER, pixels[:, :2] / pixels[:, 2:] + error)


def image_of(beam, *shape, still=None, centre=None):
    """Mask (HEIGHT, WIDTH) of the beam with mu / rho, and what else its shape depends on, filled triangle by triangle.

    Args:
        still: whose camera is used, by default that of `observe`.
        centre: change of the principal point [px].
    """
    drawn = observe(np.pad(np.ones((2, 2), dtype=bool), ((0, HEIGHT - 2), (0, WIDTH - 2))))  # any contour
    if still is not None:
        drawn = replace(drawn, K=still.K, camera=still.camera)
    residuals = StillResiduals(drawn, beam, POSE, PLACEMENT, 0.004, *shape, centre=centre)
    return silhouette(residuals.surface(np.zeros(UNKNOWNS))[1], beam.triangles, HEIGHT, WIDTH)


def depth_camera(mask):
    """A still of a second camera without a marker. A strip across the beam and the box at its root are unknown."""
    K2, camera = K.copy(), np.eye(4)
    K2[0, 0] = K2[1, 1] = 740.0
    camera[:3, :3] = Rotation.from_euler("xy", [1.5, -1.0], degrees=True).as_matrix()
    camera[:3, 3] = 0.001, -0.014, 0.002
    unknown = np.zeros((HEIGHT, WIDTH), dtype=bool)
    unknown[:, 520:570] = unknown[:, 720:] = True
    return Still(mask & ~unknown, K2, np.empty((0, 3)), np.empty((0, 2)), camera, unknown)


def filmed(beam, shape, folder, still=None):
    """Mask (HEIGHT, WIDTH) of the beam rendered by Blender, with its root behind a box. Arguments as of `image_of`."""
    x = beam.positions(np.array([*shape, 0.0, 0.0, 0.0][:4])) + PLACEMENT
    x[:, 1] += 1.0  # above Blender's floor
    pose, focal = (POSE, K[0, 0]) if still is None else (still.camera @ POSE, still.K[0, 0])
    high = pose @ np.block([[np.eye(3), np.array([[0.0], [-1.0], [0.0]])], [np.zeros(3), 1.0]])
    views = Views(np.linalg.inv(high)[None] @ np.diag([1.0, -1.0, -1.0, 1.0]), focal, WIDTH, HEIGHT)
    box = trimesh.creation.box((0.05, 0.08, 0.05)).apply_translation(PLACEMENT + [0.085, 1.0, 0.0])
    hides = Obstacle(np.asarray(box.vertices), np.asarray(box.faces), np.eye(4)[None], (0.9, 0.9, 0.9))
    surface = Surface(x[None], beam.triangles, np.full_like(x, 0.5))
    render_images(surface, views, [(0, 0)], folder, ["beam.png"], samples=8, obstacles=[hides])
    with Image.open(folder / "beam.png") as image:
        return np.asarray(image)[..., 3] > 127


def write_swing(root, frames, folder="swing"):
    """A folder of label maps of silhouettes (time [s] -> still), and the second camera."""
    (root / folder).mkdir()
    for k, still in enumerate(frames.values()):
        labels = np.where(still.unknown, 128, np.where(still.mask, 255, 0))
        Image.fromarray(np.uint8(labels)).save(root / folder / f"label_{k:02d}.png")
    times = {"figures": {str(k): time for k, time in enumerate(frames)}}
    (root / folder / "times.json").write_text(json.dumps(times))
    still, values = next(iter(frames.values())), json.loads((root / "calibration.json").read_text())
    values["depth"] = {"fx": still.K[0, 0], "fy": still.K[1, 1]}
    values["depth"] |= {"cx": still.K[0, 2] - 0.5, "cy": still.K[1, 2] - 0.5}
    values["colour_to_depth_rotation"] = still.camera[:3, :3].tolist()
    values["colour_to_depth_translation_m"] = still.camera[:3, 3].tolist()
    (root / "calibration.json").write_text(json.dumps(values))


def write_record(root, masks, record="twin"):
    """A folder for `neuma_lib.io.datasets.stills`. Photographs are the masks, the mesh is in centimetres."""
    frames = []
    for k, mask in enumerate(masks):
        Image.fromarray(np.uint8(255 * mask)).save(root / f"mask_{k}.png")
        corners = (observe(mask, k + 1).marker_pixels - 0.5).tolist()
        frames.append({"file": f"mask_{k}.png", "mask": f"mask_{k}.png", "marker_corners_px": corners})
    (root / "frames.json").write_text(json.dumps({record: {"frames": frames}}))
    camera = {"fx": K[0, 0], "fy": K[1, 1], "cx": K[0, 2] - 0.5, "cy": K[1, 2] - 0.5}
    calibration = {"colour": camera, "marker": {"side_m": 0.02}}
    (root / "calibration.json").write_text(json.dumps(calibration))
    mesh = dumbbell()
    mesh.apply_scale(100.0)
    mesh.export(root / "beam.obj")
