"""A small project with results, as the viewer finds it: a block that is stretched while it falls."""

import shutil
from pathlib import Path

import numpy as np
import torch
from PIL import Image

from neuma_lib.coupling.particle_binding import bind
from neuma_lib.io.files import write_json
from neuma_lib.io.gaussians import save_gaussians
from neuma_lib.io.hdf5 import write_arrays
from neuma_lib.io.images import write_transforms
from neuma_lib.io.laws import save_prior
from neuma_lib.io.particles import save_binding, save_particles
from neuma_lib.mechanics.neural import neural_law
from neuma_lib.splatting.gaussians import Gaussians

ROOT = Path(__file__).resolve().parents[2]
SCENE = "BouncyBall"
STEPS = (0, 10, 20, 30)
STRETCH = torch.diag(torch.tensor([1.1, 0.9, 1.0]))  # of the last frame
FALL = 0.12
LAW = {"elasticity": {"name": "hencky", "E": 5e4, "nu": 0.3}}
SIDE = 0.2


def block(count, seed):
    """Particles that fill a cube in the middle of the box, float32."""
    generator = torch.Generator().manual_seed(seed)
    return 0.4 + SIDE * torch.rand(count, 3, generator=generator)


def motion(x0):
    """Positions (T, N, 3) and deformations of particles at the frames."""
    share = torch.linspace(0, 1, len(STEPS))[:, None, None]
    F = torch.eye(3) + share * (STRETCH - torch.eye(3))
    fall = torch.tensor([0.0, -FALL, 0.0]) * share
    return 0.5 + (x0 - 0.5) @ F.mT + fall, F[:, None].expand(-1, len(x0), 3, 3).contiguous()


def make_project(root, methods=("nclaw", "constants"), scene=SCENE):
    """Write settings, data and results below a folder; the folder of the scene."""
    shutil.copytree(ROOT / "config", root / "config")
    results, data = root / "results" / scene, root / "data" / scene
    x0 = block(400, 0)
    corner = torch.cartesian_prod(*[torch.linspace(0.42, 0.58, 4)] * 3)
    generator = torch.Generator().manual_seed(2)
    G = len(corner)
    gaussians = Gaussians(
        means=corner,
        quats=torch.tensor([1.0, 0.0, 0.0, 0.0]).repeat(G, 1),
        scales=torch.tensor([0.04, 0.03, 0.035]).repeat(G, 1),
        opacities=torch.full((G,), 0.9),
        sh0=torch.rand(G, 1, 3, generator=generator) * 3 - 1.5,
        shN=torch.rand(G, 3, 3, generator=generator) * 0.2,
    )
    results.mkdir(parents=True)
    save_gaussians(results / "gaussians.ply", gaussians)
    save_particles(results / "particles.h5", x0, torch.full((400,), SIDE**3 / 400), {"added": 0})
    save_binding(results / "binding.h5", bind(gaussians.means, gaussians.covars(), x0))
    start = {"v0": [0.0, 0.0, 0.0], "angular_velocity": [0.0, 0.0, 0.0], "centre": [0.5, 0.5, 0.5]}
    write_json(results / "velocity.json", start)
    write_json(results / "identified.json", {"law": LAW, "start": start})
    (root / "results" / "priors").mkdir()
    save_prior(root / "results" / "priors" / "jelly.safetensors", neural_law(seed=1), {})
    x, F = motion(x0)
    for method in methods:
        path = {"x": x.numpy(), "F": F.numpy(), "frames": np.asarray(STEPS)}
        write_arrays(results / method / "rollout.h5", path, {"dt": 1e-3})
    x, F = motion(block(900, 7))
    truth = {"x": x.numpy(), "F": F.numpy(), "v": np.ones_like(x), "frames": np.asarray(STEPS)}
    write_arrays(data / "truth.h5", truth, {"dt": 1e-3, "bodies": [{"law": LAW}], "simulation": {"dt": 1e-3}})
    write_images(data / "dynamic")
    return results


def make_splat(root):
    """A project with a scene that is a splat, without a truth and images: its folder, and the file of its settings."""
    results = make_project(root, [f"nclaw+law_from={SCENE}"], "Splat")
    shutil.rmtree(root / "data")
    write_json(root / "splat.yaml", {"scenes": {"Splat": {"splat": "splat.ply", "dt": 5e-4, "steps": 60}}})
    return results, root / "splat.yaml"


def write_images(folder, name="d_{step}.png"):
    """One view with an image at every frame."""
    folder.mkdir(parents=True, exist_ok=True)
    pose = [[1, 0, 0, 0.5], [0, 1, 0, 0.4], [0, 0, 1, 1.6], [0, 0, 0, 1]]
    frames = []
    for step in STEPS:
        picture = np.full((24, 32, 4), 255, np.uint8)
        picture[..., 1] = 2 * step
        Image.fromarray(picture).save(folder / name.format(step=step))
        frames.append(
            {"file_path": name.format(step=step), "transform_matrix": pose, "view": 0, "step": step}
        )
    intrinsics = {"w": 32, "h": 24, "fl_x": 40.0, "fl_y": 40.0, "cx": 16.0, "cy": 12.0}
    write_transforms(folder / "transforms.json", intrinsics, frames)
