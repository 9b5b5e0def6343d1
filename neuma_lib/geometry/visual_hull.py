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
_BAND = 6.0
"""Distance from a contour [px] up to which it is measured to a small part of a pixel."""
_CONTOUR_STEPS = 8
"""Points on each segment of a contour; a segment is at most a pixel's diagonal long."""
_FIELD_OF_VIEW = 0.75
"""Half side of the searched cube over the width that the nearest camera sees at the cube's centre."""


@dataclass(frozen=True)
class HullRules:
    """What else bounds a hull, or does not.

    Attributes:
        agreement: share of the masks that must hold a point; with 1 the hull is the intersection of all, and a single
            mask that lacks a part of the object takes it from the body.
        floor: height [m] of the floor, y up, below which nothing is; None: there is none. The underside of an object
            that lies on it is seen by no camera.
    """

    agreement: float = 1.0
    floor: float | None = None

    def spare(self, views: int) -> int:
        """How many of the masks may lack a point of the hull."""
        return int((1.0 - self.agreement) * views + 1e-9)


ALL_AGREE = HullRules()


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
    rules: HullRules = ALL_AGREE,
) -> Tensor:
    """Signed distance [m] of points to the surface of the hull, negative outside, shape (P,).

    It is the least one to the silhouette cones, or of those that are left without the masks that may be wrong. A
    distance in the image is turned into metres at the point's depth. Points behind a camera are outside of its cone.

    Args:
        points: positions [m], float64, shape (P, 3).
        contours: result of `contour_distances`, V of shape (H, W).
        cameras: V cameras in float64, or V sets of one where sizes differ.
        rules: how many masks must agree, and the floor.
    """
    spare = rules.spare(len(contours))
    least = torch.full((spare + 1, len(points)), float("inf"), dtype=torch.float64)
    for contour, camera in zip(contours, cameras, strict=True):
        size = torch.tensor([camera.width, camera.height], dtype=torch.float64)
        pixels, depth = camera.project(points)
        where = (2.0 * pixels / size - 1.0).nan_to_num(nan=2.0)[None]
        distance = torch.nn.functional.grid_sample(
            contour[None, None], where, mode="bilinear", padding_mode="border", align_corners=False
        )
        # beyond the frame the contour is at least as far again, unless the frame cuts the body off
        beyond = (pixels[0] - pixels[0].clamp(min=torch.zeros(2, dtype=torch.float64), max=size)).norm(dim=-1)
        distance = torch.where(distance[0, 0, 0] < 0, distance[0, 0, 0] - beyond, distance[0, 0, 0])
        distance = distance * depth[0] / camera.Ks[0, 0, 0]
        distance = torch.where(depth[0] > 0, distance, -depth[0].abs() - 1e-3)
        for rank in range(spare + 1):  # the least ones, ascending
            least[rank], distance = torch.minimum(least[rank], distance), torch.maximum(least[rank], distance)
    found = least[spare]
    return found if rules.floor is None else torch.minimum(found, points[:, 1] - rules.floor)


def visual_hull(
    masks: Tensor | Sequence[Tensor],
    cameras: Cameras | Sequence[Cameras],
    resolution: int,
    rules: HullRules = ALL_AGREE,
) -> Hull:
    """Space seen inside the object's silhouette by every camera, or by as many as ``rules`` ask for.

    Args:
        masks: alpha in [0, 1] of V views, shape (H, W) each.
        cameras: V cameras, or V sets of one where sizes differ; the object is wholly in view of at least one.
        resolution: voxels along the longest side of the hull's bounding box.
        rules: how many masks must agree, and the floor.

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
    reach = _FIELD_OF_VIEW * (widths.median() if rules.spare(len(cameras)) else widths.min())
    lower, upper = centre - reach, centre + reach
    for size in (resolution // 2, resolution, resolution):
        voxel = float((upper - lower).max()) / size
        counts = ((upper - lower) / voxel).ceil().clamp_min(1).long().tolist()
        ticks = [
            lower[k] + (torch.arange(n, dtype=torch.float64) + 0.5) * voxel for k, n in enumerate(counts)
        ]
        centres = torch.cartesian_prod(*ticks)
        inside, missing = torch.arange(len(centres)), torch.zeros(len(centres), dtype=torch.long)
        if rules.floor is not None:
            inside = inside[centres[:, 1] > rules.floor - 0.5 * voxel]
        # most points are outside of the first few already
        for contour, camera in zip(contours, cameras, strict=True):
            missing[inside] += distance_inside(centres[inside], [contour], [camera]) <= -0.5 * voxel
            inside = inside[missing[inside] <= rules.spare(len(cameras))]
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
