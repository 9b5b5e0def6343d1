"""What several tests share of geometry."""

import numpy as np
import torch
import trimesh

from neuma_lib.splatting.gaussians import Gaussians


def some_gaussians(mesh, count=300, seed=0, outliers=0):
    """Small Gaussians on the surface of a mesh, as a static fit leaves them, with far floaters if wanted."""
    points, _ = trimesh.sample.sample_surface(mesh, count, seed=seed)
    if outliers:
        points[:outliers] += 0.8
    means = torch.as_tensor(np.asarray(points), dtype=torch.float32)
    quats = torch.tensor([1.0, 0, 0, 0]).expand(count, 4)
    return Gaussians(
        means,
        quats,
        torch.full((count, 3), 0.01),
        torch.ones(count),
        torch.zeros(count, 1, 3),
        torch.zeros(count, 0, 3),
    )
