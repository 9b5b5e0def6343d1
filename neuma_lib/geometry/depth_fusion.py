"""Fusion of depth maps to a signed distance (Curless and Levoy 1996), which resolves dents invisible in silhouettes."""

from collections.abc import Sequence

import torch
from torch import Tensor

from neuma_lib.splatting.cameras import Cameras

REACH = 1 / 16
"""Truncation distance behind the surface of a depth map, as a fraction of the body's longest side."""


def fused_distance(
    points: Tensor, depths: Sequence[Tensor], cameras: Sequence[Cameras], reach: float
) -> Tensor:
    """Weighted mean over the views of the signed distance [m] from points to the surface along rays, positive inside.

    A view contributes to points in front of its surface and up to ``reach`` behind it. The weight decreases linearly
    behind the surface, so that the other side of a thin wall has little effect. Distances are truncated at ``reach``.

    Args:
        points: positions [m], float64, shape (P, 3).
        depths: depth along the optical axis [m] at the pixel centres of V views, shape (H, W) each; not finite where a
            pixel shows no surface.
        cameras: V cameras in float64.
        reach: truncation distance [m].

    Returns:
        Distances, shape (P,); ``reach`` where no view contributes.
    """
    total, weights = points.new_zeros(2, len(points))
    for depth, camera in zip(depths, cameras, strict=True):
        pixels, z = camera.project(points)
        size = torch.tensor([camera.width, camera.height])
        at = pixels[0].floor().long()
        within = ((at >= 0) & (at < size)).all(dim=1) & (z[0] > 0)
        column, row = at.clamp_min(0).minimum(size - 1).unbind(dim=1)
        behind = z[0] - depth.to(points)[row, column]  # nan: no surface
        weight = torch.where(within & (behind < reach), (1 - behind / reach).clamp_max(1), 0)
        total += torch.where(weight > 0, weight * behind.clamp_min(-reach), 0)
        weights += weight
    return torch.where(weights > 0, total / weights, reach)
