"""Visual hull: the part of space that every silhouette covers (space carving).

Each alpha matte becomes a signed distance to its half-covered contour, which is known to a small part of a pixel; the
least of the back-projected distances over the views is close to the signed distance of the hull.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from scipy import ndimage
from scipy.spatial import cKDTree
from skimage.measure import find_contours
from torch import Tensor

from neuma_lib.errors import InputError
from neuma_lib.splatting.cameras import Cameras

MATTE_LEVEL = 0.5
"""Coverage at which a pixel counts as half inside."""
NO_COMMON_SPACE = (
    "no point of space lies inside all masks; check that they show the object alone and that the camera poses belong to"
    " these images"
)
_JUDGED_RESOLUTION = 40
"""Voxels along the longest side of the body that masks are judged by."""
_BAND = 6.0
"""Distance from a contour [px] up to which it is measured to a small part of a pixel."""
_LEAST_TOLD = 0.25
"""Share of the pictures, and two at least, that have to tell of a point: of what nearly all frames cut off, the few
that show it leave long spikes."""
_OUTSIDE = 1e-3
"""How far outside points behind a camera are at least, and those that too few pictures tell of [m]."""
_CONTOUR_STEPS = 8
"""Points on each segment of a contour; a segment is at most a pixel's diagonal long."""
_FIELD_OF_VIEW = 0.75
"""Half side of the searched cube over the width that the nearest camera sees at the cube's centre."""


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


def check_masks(masks: Tensor | Sequence[Tensor], level: float = MATTE_LEVEL) -> None:
    """Make sure that every view shows an outline.

    Raises:
        InputError: a mask (alpha, (H, W)) that is not finite, empty, or covers the frame; names the view.
    """
    for view, mask in enumerate(masks):
        if not torch.isfinite(mask).all():
            raise InputError(f"masks: the alpha of view {view} holds values that are not finite")
        if not (mask > level).any():
            raise InputError(
                f"masks: the mask of view {view} is empty (no alpha above {level}); remove the view or make its matte"
                " again"
            )
        if (mask > level).all():
            raise InputError(
                f"masks: the mask of view {view} covers the whole frame, so it shows no outline; images need an alpha"
                " matte of the object"
            )


def contour_distances(masks: Tensor | Sequence[Tensor], level: float = MATTE_LEVEL) -> list[Tensor]:
    """Signed distances [px] at the pixel centres to the contours of the masks, positive inside, float64 on the CPU.

    Args:
        masks: alpha in [0, 1] of V views, shape (H, W) each, of any sizes.
        level: alpha on the contour.

    Raises:
        InputError: see `check_masks`.
    """
    check_masks(masks, level)
    mattes = [mask.detach().to("cpu", torch.float64).numpy() for mask in masks]
    return [torch.from_numpy(_distance_to_contour(matte, level)) for matte in mattes]


def _distance_to_contour(matte: NDArray[np.float64], level: float) -> NDArray[np.float64]:
    """Signed distance [px] from pixel centres to the level line of a matte (H, W), positive inside.

    The matte is continued beyond the frame as it is at its edge, where a body may be cut off. Distances of more than
    `_BAND` pixels are those to the nearest pixel on the other side, right to about half a pixel: the surface lies where
    distances vanish, and the search for the nearest contour point is expensive deep inside.
    """
    inside = matte > level
    distance = np.where(
        inside, ndimage.distance_transform_edt(inside) - 0.5, 0.5 - ndimage.distance_transform_edt(~inside)
    )
    contours = find_contours(np.pad(matte, 1, mode="edge"), level)
    along = np.arange(_CONTOUR_STEPS)[:, None, None] / _CONTOUR_STEPS
    pieces = [((1 - along) * line[:-1] + along * line[1:]).reshape(-1, 2) for line in contours]
    near = np.abs(distance) < _BAND
    exact, _ = cKDTree(np.concatenate(pieces)).query(np.argwhere(near) + 1.0)
    distance[near] = np.where(inside[near], exact, -exact)
    return distance


def distance_inside(
    points: Tensor,
    contours: Sequence[Tensor],
    cameras: Cameras | Sequence[Cameras],
    floor: float | None = None,
) -> Tensor:
    """Least signed distance [m] of points to the silhouette cones and the floor, negative outside one, shape (P,).

    A distance in the image is turned into metres at the point's depth. Points behind a camera are outside. Of what lies
    beyond a side of the frame that cuts the body off, a picture tells nothing; points that less than `_LEAST_TOLD` of
    the pictures tell of are outside.

    Args:
        points: positions [m], float64, shape (P, 3).
        contours: result of `contour_distances`, V of shape (H, W).
        cameras: V cameras in float64, or V sets of one where sizes differ.
        floor: height y [m] below which nothing is; None: there is no floor.
    """
    least = torch.full((len(points),), float("inf"), dtype=torch.float64)
    told = torch.zeros(len(points), dtype=torch.long)
    for contour, camera in zip(contours, cameras, strict=True):
        distance = _distance_in_view(points, contour, camera)
        told += distance.isfinite()
        least = torch.minimum(least, distance)
    least = torch.where(told >= _least_told(len(contours)), least, -_OUTSIDE)
    return least if floor is None else torch.minimum(least, points[:, 1] - floor)


def _least_told(views: int) -> int:
    """Pictures that have to tell of a point."""
    return max(min(2, views), round(_LEAST_TOLD * views))


def _distance_in_view(points: Tensor, contour: Tensor, camera: Cameras) -> Tensor:
    """Signed distance [m] of points to the silhouette cone of one picture, (P,); infinite where it tells nothing."""
    size = torch.tensor([camera.width, camera.height], dtype=torch.float64)
    pixels, depth = (values[0] for values in camera.project(points))
    where = (2.0 * pixels / size - 1.0).nan_to_num(nan=2.0)[None, None]
    distance = torch.nn.functional.grid_sample(
        contour[None, None], where, mode="bilinear", padding_mode="border", align_corners=False
    )[0, 0, 0]
    # beyond the frame the contour is at least as far again
    beyond = (pixels - pixels.clamp(min=torch.zeros(2, dtype=torch.float64), max=size)).norm(dim=-1)
    distance = torch.where(distance < 0, distance - beyond, distance) * depth / camera.Ks[0, 0, 0]
    # left, top, right, bottom
    cut = [(edge > 0).any() for edge in (contour[:, 0], contour[0], contour[:, -1], contour[-1])]
    sides = torch.cat([pixels < 0, pixels > size], dim=-1)
    hidden = (sides & torch.stack(cut)).any(dim=-1)
    return torch.where(depth > 0, distance.masked_fill(hidden, float("inf")), -depth.abs() - _OUTSIDE)


def lacking(
    masks: Tensor | Sequence[Tensor],
    cameras: Cameras | Sequence[Cameras],
    agreement: float,
    floor: float | None = None,
) -> Tensor:
    """Share of the body that each mask lacks, (V,): that of a good one is small, whatever the others are.

    The body is what nearly all masks hold. It is larger than the object where few cameras see what is not there, so it
    serves for judging masks alone.

    Args:
        masks, cameras, floor: as of `visual_hull`.
        agreement: share of the masks that must hold a point of this body.
    """
    spare = int((1.0 - agreement) * len(cameras) + 1e-9)
    hull = visual_hull(masks, cameras, _JUDGED_RESOLUTION, floor, spare)
    points = (hull.origin + (hull.occupied.nonzero() + 0.5) * hull.voxel).to("cpu", torch.float64)
    views = zip(contour_distances(masks), cameras, strict=True)
    outside = [
        _distance_in_view(points, contour, camera.to("cpu", torch.float64)) <= -0.5 * hull.voxel
        for contour, camera in views
    ]
    return torch.stack(outside).double().mean(dim=1)


def visual_hull(
    masks: Tensor | Sequence[Tensor],
    cameras: Cameras | Sequence[Cameras],
    resolution: int,
    floor: float | None = None,
    spare: int = 0,
) -> Hull:
    """Space seen inside the object's silhouette by every camera, or by nearly all.

    Args:
        masks: alpha in [0, 1] of V views, shape (H, W) each.
        cameras: V cameras, or V sets of one where sizes differ; the object is wholly in view of at least one. A side of
            the frame that the mask touches cuts it off.
        resolution: voxels along the longest side of the hull's bounding box.
        floor: height y [m] below which nothing is, where no camera sees the underside; None: there is no floor.
        spare: how many masks may lack a voxel.

    Returns:
        The voxels whose centres are inside, or less than half a voxel outside, with the cameras' device and type.

    Raises:
        InputError: see `check_masks`, or no voxel lies in the silhouettes, so poses and masks contradict each other.
    """
    joined = Cameras.joined(cameras)
    kind, joined = joined.viewmats, joined.to("cpu", torch.float64)
    sizes = torch.tensor([[camera.width, camera.height] for camera in cameras], dtype=torch.float64)
    cameras = [camera.to("cpu", torch.float64) for camera in cameras]
    contours = contour_distances(masks)
    # the point nearest to the rays through the middles of all pictures, and a cube around it as large as the cameras'
    # field of view there
    eyes, axes = joined.positions, _middle_rays(joined, sizes)
    projectors = torch.eye(3, dtype=eyes.dtype) - axes[:, :, None] * axes[:, None, :]
    # a little regularisation keeps parallel axes solvable
    system = projectors.sum(0) + 1e-6 * torch.eye(3, dtype=eyes.dtype)
    centre = torch.linalg.solve(system, (projectors @ eyes[..., None]).sum(0)[:, 0] + 1e-6 * eyes.mean(0))
    widths = (eyes - centre).norm(dim=-1) * sizes.amax(dim=1) / joined.Ks[:, 0, 0]
    # a picture that shows a part of the object alone must not narrow the search where masks may be wrong
    reach = _FIELD_OF_VIEW * (widths.median() if spare else widths.min())
    lower, upper = centre - reach, centre + reach
    for size in (resolution // 2, resolution, resolution):
        voxel = float((upper - lower).max()) / size
        counts = ((upper - lower) / voxel).ceil().clamp_min(1).long().tolist()
        ticks = [
            lower[k] + (torch.arange(n, dtype=torch.float64) + 0.5) * voxel for k, n in enumerate(counts)
        ]
        centres = torch.cartesian_prod(*ticks)
        inside, (missing, told) = torch.arange(len(centres)), torch.zeros(2, len(centres), dtype=torch.long)
        if floor is not None:
            inside = inside[centres[:, 1] > floor - 0.5 * voxel]
        # most points are outside of the first few already
        for contour, camera in zip(contours, cameras, strict=True):
            distance = _distance_in_view(centres[inside], contour, camera)
            missing[inside] += distance <= -0.5 * voxel
            told[inside] += distance.isfinite()
            inside = inside[missing[inside] <= spare]
        inside = inside[told[inside] >= _least_told(len(cameras))]
        if len(inside) == 0:
            raise InputError(f"masks: {NO_COMMON_SPACE}")
        occupied = torch.zeros(counts, dtype=torch.bool)
        occupied.view(-1)[inside] = True
        found = occupied.nonzero()
        origin = lower
        lower, upper = origin + (found.amin(0) - 1) * voxel, origin + (found.amax(0) + 2) * voxel
    return Hull(occupied.to(kind.device), origin.to(kind), voxel)


def _middle_rays(cameras: Cameras, sizes: Tensor) -> Tensor:
    """Unit vectors (V, 3) through the middles of the pictures: the optical axes, unless pictures were cropped."""
    focal = cameras.Ks[:, [0, 1], [0, 1]]
    rays = torch.cat([(0.5 * sizes - cameras.Ks[:, :2, 2]) / focal, torch.ones_like(focal[:, :1])], dim=1)
    rays = rays / rays.norm(dim=1, keepdim=True)
    return torch.einsum("vji,vj->vi", cameras.viewmats[:, :3, :3], rays)
