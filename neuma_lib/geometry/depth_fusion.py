"""Depth maps of many views fused to a signed distance (Curless and Levoy 1996): dents, which no silhouette shows."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from neuma_lib.splatting.cameras import Cameras

REACH = 1 / 16
"""Distance up to which a depth map tells of what is behind its surface, in longest sides of the body."""


def fused_distance(
    points: Tensor, depths: Sequence[Tensor], cameras: Sequence[Cameras], reach: float
) -> Tensor:
    """Mean signed distance [m] along the rays from points to the surface that depth maps show, positive inside.

    A view says something of a point that lies before its surface, or not farther behind it than ``reach``, and the less
    the farther behind (so as to tell little of what another side of a thin wall looks into); distances are cut at
    ``reach``.

    Args:
        points: positions [m], float64, shape (P, 3).
        depths: along the optical axis [m] of V views, shape (H, W) each, at the pixel centres; not finite where a pixel
            shows no surface.
        cameras: V cameras in float64.
        reach: [m].

    Returns:
        distance (P,); ``reach`` where no view says anything.
    """
    total, weights = points.new_zeros(2, len(points))
    for depth, camera in zip(depths, cameras, strict=True):
        pixels, z = camera.project(points)
        size = torch.tensor([camera.width, camera.height])
        at = pixels[0].floor().long()
        within = ((at >= 0) & (at < size)).all(dim=1) & (z[0] > 0)
        column, row = at.clamp_min(0).minimum(size - 1).unbind(dim=1)
        behind = z[0] - depth.to(points)[row, column]  # nan where there is no surface
        weight = torch.where(within & (behind < reach), (1 - behind / reach).clamp_max(1), 0)
        total += torch.where(weight > 0, weight * behind.clamp_min(-reach), 0)
        weights += weight
    return torch.where(weights > 0, total / weights, reach)
