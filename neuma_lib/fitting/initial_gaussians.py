"""Initial Gaussians of a static fit: points sampled in the visual hull, with colours from the images."""

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from neuma_lib.config.gaussians import GaussiansConfig
from neuma_lib.geometry.visual_hull import Hull
from neuma_lib.splatting.cameras import Cameras
from neuma_lib.splatting.gaussians import Gaussians
from neuma_lib.splatting.spherical_harmonics import coefficient_count, rgb_to_sh0

_SHEET_PACKING = 1.15  # squared spacing per area of a point in a hexagonal sheet, 2 / sqrt(3) rounded
_VOLUME_PACKING = 1.41  # cubed spacing per volume of a point in close packing, sqrt(2) rounded
START_SCALE = 0.5  # initial standard deviation relative to the spacing
_COLOUR_DEPTHS = 0.05
"""Decay length of the weights of cameras in the initial colours, as a share of the mean depth."""


def initial_gaussians(
    hull: Hull,
    images: Sequence[Tensor],
    cameras: Cameras | Sequence[Cameras],
    settings: GaussiansConfig,
    generator: torch.Generator,
) -> tuple[Gaussians, float]:
    """Isotropic Gaussians, mostly near the surface of the hull, and their mean spacing [m].

    Args:
        images: RGBA images (H, W, 4), for the colours.
        settings: counts, opacity and degree of the harmonics.
        generator: source of the random positions.
    """
    solid = hull.occupied.float()[None, None]
    eroded = -torch.nn.functional.max_pool3d(-torch.nn.functional.pad(solid, (1,) * 6), 3, stride=1)
    shell = hull.occupied & (eroded[0, 0] < 0.5)
    inner = hull.occupied & ~shell
    wanted_inside = round(settings.interior * settings.initial_count) if inner.any() else 0
    wanted = ((shell, settings.initial_count - wanted_inside), (inner, wanted_inside))
    # a shell voxel represents about one voxel^2 of surface
    surface_spacing = hull.voxel * math.sqrt(_SHEET_PACKING * float(shell.sum()) / wanted[0][1])
    volume_spacing = hull.voxel * (_VOLUME_PACKING * float(inner.sum()) / max(wanted_inside, 1)) ** (1 / 3)
    means, spacings = [], []
    for (voxels, count), spacing in zip(wanted, (surface_spacing, volume_spacing), strict=True):
        candidates = voxels.nonzero().to(hull.origin)
        if count == 0 or len(candidates) == 0:
            continue
        picked = _spread(candidates * hull.voxel, count, generator)
        jitter = torch.rand(len(picked), 3, generator=generator).to(hull.origin)
        means.append(hull.origin + (candidates[picked] + jitter) * hull.voxel)
        spacings.append(torch.full((len(picked),), spacing).to(hull.origin))
    means, spacing = torch.cat(means), torch.cat(spacings)
    count, higher = len(means), coefficient_count(settings.sh_degree) - 1
    identity = torch.zeros(count, 4).to(means)
    identity[:, 0] = 1
    gaussians = Gaussians(
        means=means,
        quats=identity,
        scales=(START_SCALE * spacing[:, None]).expand(-1, 3).clone(),
        opacities=torch.full_like(spacing, settings.initial_opacity),
        sh0=rgb_to_sh0(_mean_colours(means, images, cameras))[:, None],
        shN=torch.zeros(count, higher, 3).to(means),
    )
    return gaussians, surface_spacing


def _spread(points: Tensor, count: int, generator: torch.Generator) -> Tensor:
    """Indices of about ``count`` points, a random one in each cell of a grid with about that many occupied cells."""
    if count >= len(points):
        return torch.arange(len(points), device=points.device)
    low, high = 0.0, float((points.amax(0) - points.amin(0)).max())
    shuffled = torch.randperm(len(points), generator=generator).to(points.device)
    for _ in range(20):
        size = 0.5 * (low + high)
        cells = _cell_keys(points, size)
        low, high = (size, high) if len(torch.unique(cells)) > count else (low, size)
    cells = _cell_keys(points, high)[shuffled]
    order = torch.argsort(cells, stable=True)
    first = torch.ones_like(cells, dtype=torch.bool)
    first[1:] = cells[order][1:] != cells[order][:-1]
    return shuffled[order[first]]


def _cell_keys(points: Tensor, size: float) -> Tensor:
    """Integer per point that is equal for points in the same cube of side ``size``."""
    cells = ((points - points.amin(0)) / size).long()
    extent = cells.amax(0) + 1
    return (cells[:, 0] * extent[1] + cells[:, 1]) * extent[2] + cells[:, 2]


def _mean_colours(points: Tensor, images: Sequence[Tensor], cameras: Cameras | Sequence[Cameras]) -> Tensor:
    """Colour (P, 3) of each point, averaged over the nearest cameras."""
    pixels, depths = Cameras.joined(cameras).project(points)
    rgba = []
    for pixel, image in zip(pixels.floor().long(), images):
        column, row = pixel[:, 0].clamp(0, image.shape[1] - 1), pixel[:, 1].clamp(0, image.shape[0] - 1)
        rgba.append(image[row, column])
    rgba = torch.stack(rgba)
    # a point on the surface is occluded in half of the views, but usually not in the nearest ones
    weights = rgba[..., 3] * torch.softmax(-depths / (_COLOUR_DEPTHS * depths.mean()), dim=0)
    return (weights[..., None] * rgba[..., :3]).sum(0) / weights.sum(0)[:, None].clamp_min(1e-6)
