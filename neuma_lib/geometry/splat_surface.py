"""A watertight surface of Gaussians, from the opacity and depth of renders from all directions."""

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
"""Variance added to a splat by a pixel [px^2], as in the 3DGS release, whose renderer such Gaussians are fitted for."""


def views_around(gaussians: Gaussians, count: int, pixels: int) -> Cameras:
    """Cameras evenly distributed around Gaussians, ``pixels`` x ``pixels`` each, that see all of them."""
    around = outermost(gaussians.means.detach(), gaussians.covars().detach(), gaussians.opacities.detach())
    views = static_views(around.cpu().numpy(), count, pixels, pixels)
    Ks = torch.from_numpy(np.repeat(views.K[None], count, axis=0))
    return Cameras(torch.from_numpy(views.viewmats), Ks, pixels, pixels).to(dtype=gaussians.means.dtype)


def splat_surface(
    gaussians: Gaussians, cameras: Cameras, settings: SurfaceConfig, *, dents: bool = True
) -> trimesh.Trimesh:
    """Surface (`reconstruct`) from the opacity and, with ``dents``, the depth of Gaussians in all views."""
    images, depths = opacity_and_depth(gaussians, cameras, settings.matte_level)
    return reconstruct(gaussians, cameras, images, settings, depths=list(depths) if dents else None)


def opacity_and_depth(gaussians: Gaussians, cameras: Cameras, level: float) -> tuple[Tensor, Tensor]:
    """RGBA images (V, H, W, 4), of which only alpha is meaningful, and depths along the optical axes (V, H, W).

    The depth of a pixel is that of the mean of the Gaussian centres on its ray, with the weights of their colours. It
    is computed by rendering the centres as colours. The squares of the centres give the standard deviation. A pixel
    with a deviation above `REACH` (of the body's longest side) looks partly through a gap and has no depth.

    Returns:
        images; depths [m], nan where alpha is below ``level`` or the deviation is too large.
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
