"""Pictures of what the stages of the pipeline make: views, kernels, surface, particles, stresses."""

from __future__ import annotations

import dataclasses

import matplotlib
import numpy as np
import torch
import trimesh
from PIL import Image
from torch import Tensor

from neuma_lib.coupling.reconstruction import Reconstruction
from neuma_lib.evaluation.figures.pictures import as_bytes, cropped, particle_pictures, sphere_radius
from neuma_lib.mechanics.law import Law
from neuma_lib.splatting.cameras import Cameras
from neuma_lib.splatting.gaussians import Gaussians
from neuma_lib.splatting.rasterizer import rasterize
from neuma_lib.splatting.spherical_harmonics import rgb_to_sh0, sh0_to_rgb

_SHRINK = 0.45
"""Size of kernels where each shall be seen."""
_LIGHT = np.array([-0.45, 0.75, 0.5]) / np.linalg.norm([-0.45, 0.75, 0.5])
"""Direction to the light in the world (y up, the frontal camera at +z)."""
_NEUTRAL = np.array([0.72, 0.75, 0.80])


def montage(images: np.ndarray, height: int, width: int) -> np.ndarray:
    """Four pictures (4, H, W, 3) as one of a size, white around them."""
    (images,) = cropped([images], margin=0.0)
    both = np.concatenate([np.concatenate(list(images[i : i + 2]), axis=1) for i in (0, 2)], axis=0)
    factor = min(height / both.shape[0], width / both.shape[1])
    inner = round(both.shape[1] * factor), round(both.shape[0] * factor)
    page = Image.new("RGB", (width, height), "white")
    page.paste(
        Image.fromarray(both).resize(inner, Image.LANCZOS), ((width - inner[0]) // 2, height - inner[1])
    )
    return np.asarray(page)


def kernels(gaussians: Gaussians, cameras: Cameras) -> np.ndarray:
    """The Gaussian kernels, shrunk so that each can be seen: uint8 (H, W, 3)."""
    small = dataclasses.replace(gaussians, scales=_SHRINK * gaussians.scales)
    return _splat(small.means, small.covars(), small.opacities.clamp(min=0.8), small.sh(), cameras)


def surface(mesh: trimesh.Trimesh, cameras: Cameras) -> np.ndarray:
    """A mesh in grey, as flat splats on its faces: uint8 (H, W, 3)."""
    edges = torch.tensor(mesh.triangles - mesh.triangles_center[:, None], dtype=torch.float32)
    covars = edges.mT @ edges / 2 + 1e-8 * torch.eye(3)
    light = 0.35 + 0.65 * np.clip(mesh.face_normals @ _LIGHT, 0, None)
    colors = torch.from_numpy(light[:, None] * _NEUTRAL).float()
    means = torch.tensor(mesh.triangles_center, dtype=torch.float32)
    return _splat(means, covars, torch.full((len(means),), 0.99), rgb_to_sh0(colors)[:, None], cameras)


def bound_particles(body: Reconstruction, cameras: Cameras) -> np.ndarray:
    """Particles in the colours of the kernels that they carry, others grey: uint8 (H, W, 3)."""
    colors = _base_colors(body.gaussians)
    rows = torch.repeat_interleave(torch.arange(len(colors)), body.binding.counts)
    count = len(body.x0)
    total = torch.zeros(count, 3).index_add_(
        0, body.binding.indices, body.binding.values[:, None] * colors[rows]
    )
    weight = torch.zeros(count).index_add_(0, body.binding.indices, body.binding.values)
    carried = torch.where(
        weight[:, None] > 0, total / weight.clamp(min=1e-9)[:, None], torch.tensor(_NEUTRAL).float()
    )
    return particle_pictures(body.x0[None], carried.numpy(), sphere_radius(body.vol0), cameras)[0]


def plain_particles(body: Reconstruction, cameras: Cameras) -> np.ndarray:
    """Particles at the start in grey: uint8 (H, W, 3)."""
    return particle_pictures(body.x0[None], _NEUTRAL, sphere_radius(body.vol0), cameras)[0]


def stressed_particles(
    law: Law, body: Reconstruction, x: Tensor, F: Tensor, cameras: Cameras, ramp: str
) -> tuple[np.ndarray, float]:
    """Particles coloured by the von Mises stress that a law gives them.

    Args:
        law: material.
        body: for the size of the particles.
        x, F: states, (T, N, 3) [m] and (T, N, 3, 3).
        ramp: colour map of matplotlib, from no stress to the strongest.

    Returns:
        uint8 pictures (T, H, W, 3), and the stress at the end of the ramp [Pa] (95th percentile of the
        states after the first).
    """
    weights = tuple(w.detach() for w in law.elasticity.weights())
    with torch.no_grad():
        tau = law.elasticity.evaluate(F.reshape(-1, 3, 3), weights)
    tau = 0.5 * (tau + tau.mT)
    mean = tau.diagonal(dim1=1, dim2=2).mean(1)
    deviator = tau - mean[:, None, None] * torch.eye(3)
    stress = (1.5 * deviator.square().sum((1, 2))).sqrt().reshape(x.shape[:2]).numpy()
    strongest = float(np.quantile(stress[1:], 0.95))
    colors = matplotlib.colormaps[ramp](0.1 + 0.9 * np.clip(stress / strongest, 0, 1))[..., :3]
    radius = sphere_radius(body.vol0)
    pictures = [particle_pictures(state[None], c, radius, cameras)[0] for state, c in zip(x, colors)]
    return np.stack(pictures), strongest


def difference(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Absolute difference of uint8 pictures, black where they differ most, white where they agree."""
    return 255 - np.abs(a.astype(np.int16) - b.astype(np.int16)).max(-1, keepdims=True).repeat(3, -1).astype(
        np.uint8
    )


def _base_colors(gaussians: Gaussians) -> Tensor:
    """Colours (G, 3) of the kernels without their dependence on the view."""
    return sh0_to_rgb(gaussians.sh0[:, 0]).clamp(0, 1)


def _splat(means: Tensor, covars: Tensor, opacities: Tensor, sh: Tensor, cameras: Cameras) -> np.ndarray:
    with torch.no_grad():
        images, _ = rasterize(
            means[None], covars[None], opacities, sh, cameras.viewmats, cameras.Ks, cameras.width, cameras.height,
            background=(1.0, 1.0, 1.0), eps2d=0.0,
        )  # fmt: skip
    return as_bytes(images[0, 0])
