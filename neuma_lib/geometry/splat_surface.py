"""A watertight surface of Gaussians alone, from opacity and depth in renders from all around."""

from __future__ import annotations

import numpy as np
import torch
import trimesh
from torch import Tensor

from neuma_lib.config.geometry import SurfaceConfig
from neuma_lib.geometry.depth_fusion import REACH
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
    """The surface that opacity and depth of Gaussians show in all views (`reconstruct`); without ``dents``, opacity."""
    images, depths = opacity_and_depth(gaussians, cameras, settings.matte_level)
    return reconstruct(gaussians, cameras, images, settings, depths=list(depths) if dents else None)


def opacity_and_depth(gaussians: Gaussians, cameras: Cameras, level: float) -> tuple[Tensor, Tensor]:
    """RGBA images (V, H, W, 4), of which alpha counts, and depths along the optical axes (V, H, W) of Gaussians.

    The depth of a pixel is that of the mean of the centres on its ray, with the weights that blend their colours: one
    rendering gives both, with the centres as colours, and one of their squares how far apart they lie. A pixel that
    blends what is farther apart than `REACH` looks partly through a gap, and its mean is no surface.

    Returns:
        images; depths [m], nan where alpha is below ``level`` or the pixel looks partly through a gap.
    """
    low, high = gaussians.means.amin(dim=0), gaussians.means.amax(dim=0)
    span = float((high - low).max()) or 1.0
    centres = (gaussians.means - low) / span

    def blended(values: Tensor) -> tuple[Tensor, Tensor]:
        sh = (values - 0.5)[:, None] / SH_C0
        with torch.no_grad():
            colours, alphas = rasterize(
                gaussians.means[None], gaussians.covars()[None], gaussians.opacities, sh,
                cameras.viewmats, cameras.Ks, cameras.width, cameras.height, background=(0, 0, 0), eps2d=PIXEL_BLUR,
            )  # fmt: skip
        return colours[0], alphas[0]

    colours, alphas = blended(centres)
    weight = alphas.clamp_min(level)[..., None]
    mean, squares = colours / weight, blended(centres.square())[0] / weight
    spread = (squares - mean.square()).sum(dim=-1).clamp_min(0).sqrt()
    along = torch.einsum("vi,vhwi->vhw", cameras.viewmats[:, 2, :3], low + span * mean)
    depths = along + cameras.viewmats[:, 2, 3, None, None]
    depths = torch.where((alphas > level) & (spread < REACH), depths, torch.nan)
    return torch.cat([colours, alphas[..., None]], dim=-1), depths
