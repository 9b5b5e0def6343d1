"""A watertight surface of Gaussians alone: outlines of renders from all around, for the surface from silhouettes."""

from __future__ import annotations

import numpy as np
import torch
import trimesh

from neuma_lib.config.geometry import SurfaceConfig
from neuma_lib.geometry.surface import reconstruct
from neuma_lib.splatting.cameras import Cameras
from neuma_lib.splatting.gaussians import Gaussians
from neuma_lib.splatting.rasterizer import rasterize
from neuma_lib.splatting.viewpoints import static_views

PIXEL_BLUR = 0.3
"""Variance that a pixel adds to a splat [px^2], as in the 3DGS release, for which such Gaussians were fitted."""


def views_around(gaussians: Gaussians, count: int, pixels: int) -> Cameras:
    """Cameras evenly all around Gaussians, each of ``pixels`` x ``pixels``, that see all of their centres."""
    views = static_views(gaussians.means.detach().cpu().numpy(), count, pixels, pixels)
    Ks = torch.from_numpy(np.repeat(views.K[None], count, axis=0))
    return Cameras(torch.from_numpy(views.viewmats), Ks, pixels, pixels).to(dtype=gaussians.means.dtype)


def splat_surface(gaussians: Gaussians, cameras: Cameras, settings: SurfaceConfig) -> trimesh.Trimesh:
    """The surface that the opacity of Gaussians shows in all views (`reconstruct`)."""
    with torch.no_grad():
        colours, alphas = rasterize(
            gaussians.means[None], gaussians.covars()[None], gaussians.opacities, gaussians.sh(),
            cameras.viewmats, cameras.Ks, cameras.width, cameras.height, background=(0, 0, 0), eps2d=PIXEL_BLUR,
        )  # fmt: skip
    return reconstruct(gaussians, cameras, torch.cat([colours[0], alphas[0][..., None]], dim=-1), settings)
