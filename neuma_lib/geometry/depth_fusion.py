"""Depth maps of many views fused to a signed distance (Curless and Levoy 1996): dents, which no silhouette shows."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from neuma_lib.splatting.cameras import Cameras


def fused_distance(
    points: Tensor, depths: Sequence[Tensor], cameras: Sequence[Cameras], reach: float, least: int = 1
) -> Tensor:
    """Mean signed distance [m] along the rays from points to the surface that depth maps show, positive inside.

    A view says something of a point that lies before its surface, or not farther behind it than ``reach``; distances
    are cut at ``reach``.

    Args:
        points: positions [m], float64, shape (P, 3).
        depths: along the optical axis [m] of V views, shape (H, W) each, at the pixel centres; not finite where a pixel
            shows no surface.
        cameras: V cameras in float64.
        reach: [m].
        least: views that have to see a point before their surface, or it is inside: fewer look through a gap between
            Gaussians at what is behind.

    Returns:
        distance (P,); ``reach`` where no view says anything, or too few that it is outside.
    """
    total, seen, outside = points.new_zeros(3, len(points))
    for depth, camera in zip(depths, cameras, strict=True):
        pixels, z = camera.project(points)
        size = torch.tensor([camera.width, camera.height])
        at = pixels[0].floor().long()
        within = ((at >= 0) & (at < size)).all(dim=1) & (z[0] > 0)
        column, row = at.clamp_min(0).minimum(size - 1).unbind(dim=1)
        behind = z[0] - depth.to(points)[row, column]  # nan where there is no surface
        counts = within & (behind < reach)
        total += torch.where(counts, behind.clamp_min(-reach), 0.0)
        seen += counts
        outside += counts & (behind < 0)
    told = (seen > 0) & ((total >= 0) | (outside >= least))
    return torch.where(told, total / seen.clamp_min(1), reach)
