"""Small image sets in the layouts of PAC-NeRF and Spring-Gaus."""

import json

import numpy as np
from PIL import Image

from neuma_lib.io.datasets.layouts import OFFSETS
from workflow.inputs import COUNTED

SIZE = WIDTH, HEIGHT = 40, 36
K = [[52.0, 0.0, 19.0], [0.0, 50.0, 18.5], [0.0, 0.0, 1.0]]
RADIUS = 0.2


def centre_of(kind, frame):
    """Centre of a ball in their world, which falls and drifts; the ground of Spring-Gaus' is at y = 0.3."""
    start = np.array([0.0, 0.5, 0.0]) if kind == "pac_nerf" else np.array([0.5, 0.7, 0.5])
    return start + frame * np.array([0.02, -0.05, 0.01])


def poses_of(kind, count):
    """OpenGL cameras (camera to world) on a ring, which are aimed from above at the start of the ball."""
    target, poses = centre_of(kind, 0), []
    for angle in np.linspace(0.3, 5.0, count):
        eye = target + np.array([1.4 * np.cos(angle), 0.5, 1.4 * np.sin(angle)])
        back = (eye - target) / np.linalg.norm(eye - target)
        right = np.cross([0.0, 1.0, 0.0], back)
        right /= np.linalg.norm(right)
        poses.append(np.column_stack([right, np.cross(back, right), back, eye]))
    return np.array(poses)


def picture(pose, centre, background):
    """A shaded ball, a ray a pixel through its centre: RGBA with the true mask, over a background (H, W, 3)."""
    u, v = np.meshgrid(np.arange(WIDTH) + 0.5, np.arange(HEIGHT) + 0.5)
    rays = np.stack([(u - K[0][2]) / K[0][0], -(v - K[1][2]) / K[1][1], -np.ones_like(u)], axis=-1)
    rays = rays @ pose[:, :3].T
    b, c = rays @ (pose[:, 3] - centre), ((pose[:, 3] - centre) ** 2).sum() - RADIUS**2
    a = (rays**2).sum(axis=-1)
    inside = b**2 > a * c
    shade = (40 + 200 * (b**2 - a * c) / (b**2 - a * c).max()).clip(0, 255)
    colours = np.where(inside[..., None], np.stack([shade, 0.5 * shade, 20 + 0 * shade], axis=-1), background)
    return np.dstack([colours, 255 * inside]).astype(np.uint8)


def write_pac_nerf(folder, cameras=3, frames=4, form="matted"):
    """A set in PAC-NeRF's layout, and its pictures by camera and frame; masks as 'matted', 'background' or 'alpha'."""
    (folder / "data").mkdir(parents=True)
    entries, truth, seed = [], {}, np.random.default_rng(0)
    for view, pose in enumerate(poses_of("pac_nerf", cameras)):
        background = seed.integers(100, 180, (HEIGHT, WIDTH, 3)).astype(np.uint8)
        background[..., 2] = 250
        for frame in (-1, *range(frames)):
            name = f"data/r_{view}_{frame}.png"
            time = max(frame, 0) / 24
            entries.append({"file_path": name, "c2w": pose.tolist(), "intrinsic": K, "time": time})
            if frame < 0:
                Image.fromarray(background).save(folder / name)
                continue
            image = picture(pose, centre_of("pac_nerf", frame), background)
            truth[view, frame] = image
            Image.fromarray(image if form == "alpha" else image[..., :3]).save(folder / name)
            if form == "matted":
                white = np.where(image[..., 3:] > 0, image[..., :3], 255).astype(np.uint8)
                Image.fromarray(white).save(folder / f"data/m_{view}_{frame}.png")
    path = folder / "all_data.json"
    path.write_text(json.dumps(entries))
    return path, truth


def write_spring_gaus(folder, cameras=3, frames=4):
    """A set in the layout of Spring-Gaus' synthetic scenes, and its pictures by camera and frame."""
    entries, truth = [], {}
    for view, pose in enumerate(poses_of("spring_gaus", cameras)):
        name = f"camera_{view:02d}"
        (folder / name).mkdir(parents=True)
        entries.append({"camera": name, "K": K, "c2w": [*pose.tolist(), [0, 0, 0, 1]]})
        for frame in range(frames):
            truth[view, frame] = picture(pose, centre_of("spring_gaus", frame), np.zeros(3))
            Image.fromarray(truth[view, frame]).save(folder / name / f"{frame:03}.png")
    (folder / "frame.json").write_text(json.dumps(list(range(frames))))
    path = folder / "camera.json"
    path.write_text(json.dumps(entries))
    return path, truth


WRITERS = {"pac_nerf": write_pac_nerf, "spring_gaus": write_spring_gaus}


def ours(kind, points, scale=1.0, offset=None):
    name = {"pac_nerf": COUNTED[0], "spring_gaus": COUNTED[1]}[kind]
    return scale * points + (OFFSETS[name] if offset is None else offset)
