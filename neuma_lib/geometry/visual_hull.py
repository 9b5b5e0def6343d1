"""Visual hull: the region of space inside every silhouette (space carving).

Each alpha matte is converted to a signed distance to its contour at half coverage, with sub-pixel accuracy. The minimum
of the back-projected distances over the views approximates the signed distance of the hull.
"""

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

MATTE_LEVEL = 0.5  # alpha of the contour of a silhouette
_LACKING_RESOLUTION = 40  # voxels along the longest side of the body in `lacking`
_BAND = 6.0  # distance from a contour [px] up to which it is computed with sub-pixel accuracy
_MIN_INFORMATIVE = 0.25
"""Minimum fraction of the views, and at least two, that must have information on a point. Without it, regions cropped
by nearly all frames would form long spikes."""
_OUTSIDE = 1e-3
"""Minimum distance outside the hull of points behind a camera or with information from too few views [m]."""
_CONTOUR_STEPS = 8  # points on each segment of a contour, which is at most as long as a pixel's diagonal
_FIELD_OF_VIEW = 0.75
"""Half side of the search cube over the width that the nearest camera sees at the centre of the cube."""


@dataclass
class Hull:
    """Voxels inside every silhouette."""

    occupied: Tensor  # (X, Y, Z) bool
    origin: Tensor  # (3,) corner of the grid [m]
    voxel: float  # side of a voxel [m]


def check_masks(masks: Tensor | Sequence[Tensor], level: float = MATTE_LEVEL) -> None:
    """Check that every view shows a silhouette.

    Raises:
        InputError: a mask (alpha, (H, W)) is not finite, empty, or covers the frame; names the view.
    """
    for view, mask in enumerate(masks):
        where = f"masks: view {view}"
        if not torch.isfinite(mask).all():
            raise InputError(where, "alpha has values that are not finite")
        if not (mask > level).any():
            raise InputError(where, f"the mask is empty (no alpha > {level})", "Remove or correct it")
        if (mask > level).all():
            raise InputError(where, "the mask covers the whole frame", "Use an alpha matte of the object")


def no_common_space(remedy: str = "") -> InputError:
    """Error for masks without a common point of space."""
    check = "Check that the masks show the object alone and that the camera poses belong to these images"
    remedy = f"{check}. {remedy}" if remedy else check
    return InputError("masks", "no point of space lies inside all masks", remedy)


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

    The matte is extended beyond the frame by its values at the edge, where a body may be cropped. Distances of more
    than `_BAND` pixels are those to the nearest pixel on the other side, accurate to about half a pixel, because the
    surface depends on small distances only and the exact search is expensive deep inside.
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
    """Minimum signed distance [m] of points to the silhouette cones and the floor, negative outside, shape (P,).

    Image distances are converted to metres at the depth of the point. Points behind a camera are outside. A view has no
    information on points beyond a side of the frame that crops the body. Points with information from less than
    `_MIN_INFORMATIVE` of the views are outside.

    Args:
        points: positions [m], float64, shape (P, 3).
        contours: result of `contour_distances`, V of shape (H, W).
        cameras: V cameras in float64, or V sets of one if sizes differ.
        floor: height y [m] of the floor, below which space is empty; None: no floor.
    """
    minimum = torch.full((len(points),), float("inf"), dtype=torch.float64)
    informative = torch.zeros(len(points), dtype=torch.long)
    for contour, camera in zip(contours, cameras, strict=True):
        distance = _distance_in_view(points, contour, camera)
        informative += distance.isfinite()
        minimum = torch.minimum(minimum, distance)
    minimum = torch.where(informative >= _min_informative(len(contours)), minimum, -_OUTSIDE)
    return minimum if floor is None else torch.minimum(minimum, points[:, 1] - floor)


def _min_informative(views: int) -> int:
    """Minimum number of views with information on a point."""
    return max(min(2, views), round(_MIN_INFORMATIVE * views))


def _distance_in_view(points: Tensor, contour: Tensor, camera: Cameras) -> Tensor:
    """Signed distance [m] of points to the silhouette cone of a view, (P,); infinite where it has no information."""
    size = torch.tensor([camera.width, camera.height], dtype=torch.float64)
    pixels, depth = (values[0] for values in camera.project(points))
    where = (2.0 * pixels / size - 1.0).nan_to_num(nan=2.0)[None, None]
    distance = torch.nn.functional.grid_sample(
        contour[None, None], where, mode="bilinear", padding_mode="border", align_corners=False
    )[0, 0, 0]
    # beyond the frame, the distance to the frame is added
    beyond = (pixels - pixels.clamp(min=torch.zeros(2, dtype=torch.float64), max=size)).norm(dim=-1)
    distance = torch.where(distance < 0, distance - beyond, distance) * depth / camera.Ks[0, 0, 0]
    # left, top, right, bottom
    cropped = [(edge > 0).any() for edge in (contour[:, 0], contour[0], contour[:, -1], contour[-1])]
    sides = torch.cat([pixels < 0, pixels > size], dim=-1)
    hidden = (sides & torch.stack(cropped)).any(dim=-1)
    return torch.where(depth > 0, distance.masked_fill(hidden, float("inf")), -depth.abs() - _OUTSIDE)


def lacking(
    masks: Tensor | Sequence[Tensor],
    cameras: Cameras | Sequence[Cameras],
    agreement: float,
    floor: float | None = None,
) -> Tensor:
    """Fraction of the body outside each mask, shape (V,). It is small for a good mask, whatever the others are.

    The body is the region inside nearly all masks. It may be larger than the object and is used to check masks only.

    Args:
        masks, cameras, floor: see `visual_hull`.
        agreement: fraction of the masks that must contain a point of the body.
    """
    spare = int((1.0 - agreement) * len(cameras) + 1e-9)
    hull = visual_hull(masks, cameras, _LACKING_RESOLUTION, floor, spare)
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
    """Voxels inside the silhouettes of all cameras, or of nearly all.

    Args:
        masks: alpha in [0, 1] of V views, shape (H, W) each.
        cameras: V cameras, or V sets of one if sizes differ; at least one sees the whole object. A side of the frame
            that the mask touches crops it.
        resolution: voxels along the longest side of the hull's bounding box.
        floor: height y [m] of a floor that hides the underside from the cameras; None: no floor.
        spare: number of masks that may exclude a voxel.

    Returns:
        The voxels whose centres are inside, or less than half a voxel outside, with the cameras' device and dtype.

    Raises:
        InputError: see `check_masks`; no voxel lies in the silhouettes, so poses and masks are inconsistent.
    """
    joined = Cameras.joined(cameras)
    kind, joined = joined.viewmats, joined.to("cpu", torch.float64)
    sizes = torch.tensor([[camera.width, camera.height] for camera in cameras], dtype=torch.float64)
    cameras = [camera.to("cpu", torch.float64) for camera in cameras]
    contours = contour_distances(masks)
    # search in a cube around the point nearest to the central rays, as large as the cameras' field of view there
    eyes, axes = joined.positions, _central_rays(joined, sizes)
    projectors = torch.eye(3, dtype=eyes.dtype) - axes[:, :, None] * axes[:, None, :]
    # regularised for parallel axes
    system = projectors.sum(0) + 1e-6 * torch.eye(3, dtype=eyes.dtype)
    centre = torch.linalg.solve(system, (projectors @ eyes[..., None]).sum(0)[:, 0] + 1e-6 * eyes.mean(0))
    widths = (eyes - centre).norm(dim=-1) * sizes.amax(dim=1) / joined.Ks[:, 0, 0]
    # if masks may be wrong, a close-up of a part of the object must not limit the search
    reach = _FIELD_OF_VIEW * (widths.median() if spare else widths.min())
    if not float(reach) > 0:
        problem = "are all in one place"
        raise InputError("cameras", problem, "Give images from several places around the object")
    lower, upper = centre - reach, centre + reach
    for size in (resolution // 2, resolution, resolution):
        voxel = float((upper - lower).max()) / size
        counts = ((upper - lower) / voxel).ceil().clamp_min(1).long().tolist()
        ticks = [
            lower[k] + (torch.arange(n, dtype=torch.float64) + 0.5) * voxel for k, n in enumerate(counts)
        ]
        centres = torch.cartesian_prod(*ticks)
        inside = torch.arange(len(centres))
        missing, informative = torch.zeros(2, len(centres), dtype=torch.long)
        if floor is not None:
            inside = inside[centres[:, 1] > floor - 0.5 * voxel]
        # the first few views exclude most points
        for contour, camera in zip(contours, cameras, strict=True):
            distance = _distance_in_view(centres[inside], contour, camera)
            missing[inside] += distance <= -0.5 * voxel
            informative[inside] += distance.isfinite()
            inside = inside[missing[inside] <= spare]
        inside = inside[informative[inside] >= _min_informative(len(cameras))]
        if len(inside) == 0:
            raise no_common_space()
        occupied = torch.zeros(counts, dtype=torch.bool)
        occupied.view(-1)[inside] = True
        voxels = occupied.nonzero()
        origin = lower
        lower, upper = origin + (voxels.amin(0) - 1) * voxel, origin + (voxels.amax(0) + 2) * voxel
    return Hull(occupied.to(kind.device), origin.to(kind), voxel)


def _central_rays(cameras: Cameras, sizes: Tensor) -> Tensor:
    """Unit vectors (V, 3) through the image centres: the optical axes, unless images are cropped."""
    focal = cameras.Ks[:, [0, 1], [0, 1]]
    rays = torch.cat([(0.5 * sizes - cameras.Ks[:, :2, 2]) / focal, torch.ones_like(focal[:, :1])], dim=1)
    rays = rays / rays.norm(dim=1, keepdim=True)
    return torch.einsum("vji,vj->vi", cameras.viewmats[:, :3, :3], rays)
