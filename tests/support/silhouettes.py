"""Alpha mattes of meshes without a renderer: projected faces filled on a finer raster, then averaged."""

import numpy as np
import torch

from neuma_lib.splatting.cameras import Cameras
from neuma_lib.splatting.viewpoints import framing, sphere_directions


def cameras_around(mesh, views=50, size=128, fill=0.92):
    """Cameras on a sphere about the mesh, as the dataset has them, in float32."""
    placed = framing(sphere_directions(views), np.asarray(mesh.vertices), size, size, fill=fill)
    Ks = torch.as_tensor(np.repeat(placed.K[None], views, axis=0), dtype=torch.float32)
    return Cameras(torch.as_tensor(placed.viewmats, dtype=torch.float32), Ks, size, size)


def mattes(mesh, cameras, supersampling=4):
    """(V, H, W, 4) RGBA: white bodies, the alpha being the covered fraction of each pixel."""
    vertices = torch.as_tensor(np.array(mesh.vertices), dtype=torch.float64)
    pixels, _ = cameras.to(dtype=torch.float64).project(vertices)
    images = np.ones((len(cameras), cameras.height, cameras.width, 4), dtype=np.float32)
    for view, image in zip(pixels.numpy(), images, strict=True):
        fine = _covered(
            view[mesh.faces] * supersampling, cameras.height * supersampling, cameras.width * supersampling
        )
        blocks = fine.reshape(cameras.height, supersampling, cameras.width, supersampling)
        image[..., 3] = blocks.mean(axis=(1, 3))
    return torch.from_numpy(images)


def _covered(triangles, height, width):
    """Which samples (at half integers) of a raster lie in any of the triangles (n, 3, 2)."""
    low = np.clip(np.floor(triangles.min(axis=1) - 0.5).astype(int), 0, [width - 1, height - 1])
    high = np.clip(np.ceil(triangles.max(axis=1) - 0.5).astype(int), 0, [width - 1, height - 1])
    spans = high - low + 1
    copies = spans.prod(axis=1)
    face = np.repeat(np.arange(len(triangles)), copies)
    slot = np.arange(len(face)) - np.repeat(np.cumsum(copies) - copies, copies)
    x, y = low[face, 0] + slot % spans[face, 0], low[face, 1] + slot // spans[face, 0]
    a, b, c = (triangles[face, k] for k in range(3))

    def side(p, q):
        return (q[:, 0] - p[:, 0]) * (y + 0.5 - p[:, 1]) - (q[:, 1] - p[:, 1]) * (x + 0.5 - p[:, 0])

    sides = np.stack([side(a, b), side(b, c), side(c, a)])
    hit = (sides >= 0).all(axis=0) | (sides <= 0).all(axis=0)
    raster = np.zeros((height, width), dtype=np.float32)
    raster[y[hit], x[hit]] = 1.0
    return raster
