"""Visual hull: the part of space that every silhouette covers."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from neuma_lib.errors import InputError
from neuma_lib.splatting.cameras import Cameras


@dataclass
class Hull:
    """Voxels inside every silhouette.

    Attributes:
        occupied: (X, Y, Z) bool.
        origin: (3,) corner of the grid [m].
        voxel: side of a voxel [m].
    """

    occupied: Tensor
    origin: Tensor
    voxel: float


def visual_hull(masks: Tensor, cameras: Cameras, resolution: int) -> Hull:
    """Space seen inside the object's silhouette by every camera.

    Args:
        masks: (V, H, W) alpha in [0, 1].
        cameras: V cameras; the object is wholly in view of at least one.
        resolution: voxels along the longest side of the hull's bounding box.

    Raises:
        InputError: no voxel lies in all silhouettes, so poses and masks contradict each other.
    """
    # the point nearest to all optical axes, and a cube around it as large as the cameras' field of view there
    eyes, axes = cameras.positions, cameras.viewmats[:, 2, :3]
    projectors = torch.eye(3, dtype=eyes.dtype, device=eyes.device) - axes[:, :, None] * axes[:, None, :]
    # a little regularisation keeps parallel axes solvable
    system = projectors.sum(0) + 1e-6 * torch.eye(3, dtype=eyes.dtype, device=eyes.device)
    centre = torch.linalg.solve(system, (projectors @ eyes[..., None]).sum(0)[:, 0] + 1e-6 * eyes.mean(0))
    reach = (eyes - centre).norm(dim=-1) * 0.75 * max(cameras.width, cameras.height) / cameras.Ks[:, 0, 0]
    lower, upper = centre - reach.min(), centre + reach.min()
    for size in (resolution // 2, resolution, resolution):
        voxel = float((upper - lower).max()) / size
        counts = ((upper - lower) / voxel).ceil().clamp_min(1).long().tolist()
        axes3 = [lower[k] + (torch.arange(n, device=eyes.device) + 0.5) * voxel for k, n in enumerate(counts)]
        centres = torch.stack(torch.meshgrid(*axes3, indexing="ij"), dim=-1).reshape(-1, 3).to(eyes.dtype)
        occupied = _inside_masks(centres, masks, cameras, voxel).reshape(counts)
        if not occupied.any():
            raise InputError(
                "gaussians: no point of space lies inside all masks; check that they show the object alone "
                "and that the camera poses belong to these images"
            )
        found = occupied.nonzero()
        origin = lower
        lower, upper = origin + (found.amin(0) - 1) * voxel, origin + (found.amax(0) + 2) * voxel
    return Hull(occupied, origin, voxel)


def _inside_masks(points: Tensor, masks: Tensor, cameras: Cameras, margin: float) -> Tensor:
    """Whether points (P, 3) project into every mask, up to half of ``margin`` [m] outside its edge."""
    inside = torch.ones(len(points), dtype=torch.bool, device=points.device)
    for view in range(len(cameras)):
        remaining = inside.nonzero()[:, 0]
        if len(remaining) == 0:
            break
        pixels, depths = cameras[view].project(points[remaining])
        # a mask widened by the voxel's half size keeps voxels that the silhouette's edge crosses
        radius = int(float(0.5 * margin * cameras.Ks[view, 0, 0] / depths.median().clamp_min(margin)) + 0.5)
        mask = masks[view][None, None]
        if radius > 0:
            mask = torch.nn.functional.max_pool2d(mask, 2 * radius + 1, stride=1, padding=radius)
        column, row = (pixels[0].floor().long()).unbind(-1)
        visible = (
            (column >= 0) & (column < cameras.width) & (row >= 0) & (row < cameras.height) & (depths[0] > 0)
        )
        column, row = column.clamp(0, cameras.width - 1), row.clamp(0, cameras.height - 1)
        # outside the frame is outside the object, unless the frame cuts the object's mask
        edges = masks[view][0], masks[view][-1], masks[view][:, 0], masks[view][:, -1]
        cut = any(bool((edge > 0.5).any()) for edge in edges)
        inside[remaining] = torch.where(visible, mask[0, 0][row, column] > 0.1, cut)
    return inside
