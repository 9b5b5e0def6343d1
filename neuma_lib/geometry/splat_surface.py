"""A watertight surface of Gaussians alone, from opacity and depth in renders from all around."""

from __future__ import annotations

import numpy as np
import torch
import trimesh

from neuma_lib.config.geometry import SurfaceConfig
from neuma_lib.geometry.surface import reconstruct
from neuma_lib.splatting.cameras import Cameras
from neuma_lib.splatting.extent import outermost
from neuma_lib.splatting.gaussians import Gaussians
from neuma_lib.splatting.rasterizer import rasterize
from neuma_lib.splatting.spherical_harmonics import SH_C0
from neuma_lib.splatting.viewpoints import static_views

PIXEL_BLUR = 0.3
"""Variance that a pixel adds to a splat [px^2], as in the 3DGS release, for which such Gaussians were fitted."""


def views_around(gaussians: Gaussians, count: int, pixels: int) -> Cameras:
    """Cameras evenly all around Gaussians, each of ``pixels`` x ``pixels``, that see all of them."""
    around = outermost(gaussians.means.detach(), gaussians.covars().detach(), gaussians.opacities.detach())
    views = static_views(around.cpu().numpy(), count, pixels, pixels)
    Ks = torch.from_numpy(np.repeat(views.K[None], count, axis=0))
    return Cameras(torch.from_numpy(views.viewmats), Ks, pixels, pixels).to(dtype=gaussians.means.dtype)


def splat_surface(
    gaussians: Gaussians, cameras: Cameras, settings: SurfaceConfig, *, dents: bool = True
) -> trimesh.Trimesh:
    """The surface that opacity and depth of Gaussians show in all views (`reconstruct`); without ``dents``, opacity.

    The depth of a pixel is that of the mean of the centres on its ray, with the weights that blend their colours: one
    rendering gives both, with the centres as colours.
    """
    low, high = gaussians.means.amin(dim=0), gaussians.means.amax(dim=0)
    span = float((high - low).max()) or 1.0
    places = ((gaussians.means - low) / span - 0.5)[:, None] / SH_C0
    with torch.no_grad():
        colours, alphas = rasterize(
            gaussians.means[None], gaussians.covars()[None], gaussians.opacities, places,
            cameras.viewmats, cameras.Ks, cameras.width, cameras.height, background=(0, 0, 0), eps2d=PIXEL_BLUR,
        )  # fmt: skip
    seen = alphas[0] > settings.matte_level
    points = low + span * colours[0] / alphas[0].clamp_min(settings.matte_level)[..., None]
    along = torch.einsum("vi,vhwi->vhw", cameras.viewmats[:, 2, :3], points)
    depths = torch.where(seen, along + cameras.viewmats[:, 2, 3, None, None], torch.nan)
    images = torch.cat([colours[0], alphas[0][..., None]], dim=-1)
    return reconstruct(gaussians, cameras, images, settings, depths=list(depths) if dents else None)
