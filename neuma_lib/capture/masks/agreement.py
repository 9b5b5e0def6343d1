"""Check that masks of several views show the same object.

The voxels that lie in nearly all masks form a visual hull that tolerates some bad masks. Projected into a camera, the
hull should cover that camera's mask. A mask that contains floor or another object, or whose camera pose is wrong, does
not fit.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from neuma_lib.capture.calibration.placement import camera_centres, unit_rays
from neuma_lib.capture.masks.regions import centroid, iou, radius_of
from neuma_lib.capture.tools import opencv
from neuma_lib.errors import InputError

MIN_AGREEMENT = 0.7
"""IoU with the common body below which a mask is considered doubtful."""
MIN_SAME_OBJECT = 0.5
"""IoU below which simultaneous cameras are considered to film different objects."""
MIN_SHARES = (0.8, 0.95)
"""Share of the views of a voxel whose masks must contain it: first for all views, then without doubtful views."""
CHECK_VIDEOS = (
    "Check on the contact sheets that the videos show the same take and object, that the cameras did not move since"
    " their poses were estimated, and that no hand or shadow is in a mask"
)
_TRUNCATED = 0.7  # voxels seen by a smaller share of the maximum view count are outside many pictures
_MAX_MISSES = 2  # masks that may lack such a voxel, at most one in five
_VOXELS = (24, 64)  # along a side of the cube, in the coarse and the fine pass
_MARGIN = 1.6  # half side of the coarse cube, in radii of the masks
_CLOSING = np.ones((3, 3), np.uint8)
_NO_COMMON_VOLUME = ("masks", "no point in space lies in most of the masks", CHECK_VIDEOS)


@dataclass(frozen=True, eq=False)
class CommonBody:
    """Visual hull of several views.

    Attributes:
        points: voxel centres, (P, 3).
        voxel: voxel side.
        agreement: IoU of each mask with the projected hull, (N,).
    """

    points: np.ndarray
    voxel: float
    agreement: np.ndarray

    def seen(self, size: tuple[int, int], viewmat: np.ndarray, K: np.ndarray) -> tuple[np.ndarray, float]:
        """Silhouette (H, W) in a picture of a size (height, width), and the size of a voxel in it [px]."""
        body, shrink = _silhouette(self.points, self.voxel, size, viewmat, K)
        large = opencv().resize(body.astype(np.float32), size[::-1], interpolation=opencv().INTER_LINEAR)
        return large > 0.5, 1 / shrink


def agreement(masks: Sequence[np.ndarray], viewmats: np.ndarray, Ks: np.ndarray) -> np.ndarray:
    """IoU of each mask with the `common_body` of all, (N,)."""
    return common_body(masks, viewmats, Ks).agreement


def common_body(masks: Sequence[np.ndarray], viewmats: np.ndarray, Ks: np.ndarray) -> CommonBody:
    """Visual hull of masks that tolerates bad masks.

    Silhouettes are drawn at the resolution of the voxels, so an IoU is accurate to a few hundredths.

    Args:
        masks: of N >= 2 pinhole cameras, Boolean, (H, W), of any sizes, none empty.
        viewmats: world to camera, OpenCV axes, (N, 4, 4).
        Ks: [px], pixel centres at +0.5, (N, 3, 3).

    Raises:
        InputError: a mask is empty, or no point in space lies in most of them.
    """
    if empty := [str(k) for k, mask in enumerate(masks) if not mask.any()]:
        raise InputError(
            "masks",
            f"number {', '.join(empty)} of {len(masks)} is empty",
            "Leave out its picture, or provide a mask",
        )
    middle, radii = middle_and_radii(masks, viewmats, Ks)
    if not (radii > 0).any():
        raise InputError(*_NO_COMMON_VOLUME)
    reach = _MARGIN * 2 * float(np.median(radii[radii > 0]))
    views = list(zip(masks, viewmats, Ks))
    chosen = views
    for share in MIN_SHARES:
        points, voxel = _body(chosen, middle - reach, middle + reach, share)
        ious = np.array([_iou_with_body(points, voxel, *view) for view in views])
        chosen = [view for view, value in zip(views, ious) if value >= MIN_AGREEMENT]
        if len(chosen) < 2:
            break
    return CommonBody(points, voxel, ious)


def check_one_object(ious: Sequence[float], cameras: Sequence[str], name: str) -> None:
    """Raises InputError if the `agreement` of simultaneous masks shows that cameras film different objects."""
    worst = int(np.argmin(ious))
    if ious[worst] < MIN_SAME_OBJECT:
        raise InputError(
            name,
            f"the masks at rest do not show one object: that of {cameras[worst]} has an IoU of {ious[worst]:.2f} with"
            f" the common body, at least {MIN_SAME_OBJECT} is required",
            CHECK_VIDEOS,
        )


def middle_and_radii(
    masks: Sequence[np.ndarray], viewmats: np.ndarray, Ks: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Centre (3,) of an object, and its radius by each of N masks, negative behind a camera, (N,).

    Arguments are those of `common_body`.
    """
    middle = nearest_point(np.stack([centroid(mask) for mask in masks]), viewmats, Ks)
    depths = viewmats[:, 2, :3] @ middle + viewmats[:, 2, 3]
    return middle, np.array([radius_of(mask) for mask in masks]) * depths / Ks[:, 0, 0]


def nearest_point(centres: np.ndarray, viewmats: np.ndarray, Ks: np.ndarray) -> np.ndarray:
    """Point nearest to the rays through pixels (N, 2) of N cameras, robust against single outliers, (3,)."""
    rays = unit_rays(viewmats, (centres - Ks[:, :2, 2]) / Ks[:, [0, 1], [0, 1]])
    eyes = camera_centres(viewmats)
    across = np.eye(3) - rays[:, :, None] * rays[:, None]
    weights = np.ones(len(rays))
    for _ in range(20):
        normal = (weights[:, None, None] * across).sum(axis=0) + 1e-9 * np.eye(3)
        point = np.linalg.solve(normal, np.einsum("n,nij,nj->i", weights, across, eyes))
        off = np.linalg.norm(np.einsum("nij,nj->ni", across, point - eyes), axis=1)
        weights = 1 / np.maximum(off, 1e-3 * np.median(np.linalg.norm(point - eyes, axis=1)))
    return point


def projected(points: np.ndarray, viewmat: np.ndarray, K: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Pixels (P, 2), and depth (P,), of points (P, 3)."""
    seen = points @ viewmat[:3, :3].T + viewmat[:3, 3]
    return (seen[:, :2] / np.maximum(seen[:, 2:], 1e-9)) * K[[0, 1], [0, 1]] + K[:2, 2], seen[:, 2]


def _body(
    views: Sequence[tuple[np.ndarray, np.ndarray, np.ndarray]],
    lower: np.ndarray,
    upper: np.ndarray,
    share: float,
) -> tuple[np.ndarray, float]:
    """Centres (P, 3) of the voxels that lie in a share of the masks, and the voxel side."""
    for count in _VOXELS:
        voxel = float((upper - lower).max()) / count
        ticks = [lower[k] + (np.arange(np.ceil((upper - lower)[k] / voxel)) + 0.5) * voxel for k in range(3)]
        points = np.stack(np.meshgrid(*ticks, indexing="ij"), axis=-1).reshape(-1, 3)
        seen, inside = np.zeros((2, len(points)), int)
        for mask, viewmat, K in views:
            height, width = mask.shape
            pixels, depth = projected(points, viewmat, K)
            within = (depth > 0) & ((pixels >= 0) & (pixels < (width, height))).all(axis=1)
            x, y = pixels[within].astype(int).T
            seen[within] += 1
            inside[np.flatnonzero(within)[mask[y, x]]] += 1
        missed = np.where(seen < _TRUNCATED * seen.max(), np.minimum(_MAX_MISSES, seen // 5), 0)
        kept = (inside >= share * seen) | (seen - inside <= missed)
        points = points[(seen >= max(2, 0.25 * seen.max())) & kept]
        if len(points) == 0:
            raise InputError(*_NO_COMMON_VOLUME)
        lower, upper = points.min(axis=0) - 1.5 * voxel, points.max(axis=0) + 1.5 * voxel
    return points, voxel


def _iou_with_body(
    points: np.ndarray, voxel: float, mask: np.ndarray, viewmat: np.ndarray, K: np.ndarray
) -> float:
    cv2 = opencv()
    body, _ = _silhouette(points, voxel, mask.shape, viewmat, K)
    small = cv2.resize(mask.astype(np.float32), body.shape[::-1], interpolation=cv2.INTER_AREA) > 0.5
    return iou(small, body)


def _silhouette(
    points: np.ndarray, voxel: float, size: tuple[int, int], viewmat: np.ndarray, K: np.ndarray
) -> tuple[np.ndarray, float]:
    """Silhouette with pixels as large as the voxels, and the factor by which the picture (H, W) is reduced."""
    cv2 = opencv()
    pixels, depth = projected(points, viewmat, K)
    shrink = min(1.0, float(np.median(depth)) / (voxel * K[0, 0])) if (depth > 0).all() else 1.0
    width, height = (max(1, round(shrink * n)) for n in size[::-1])
    body = np.zeros((height, width), np.uint8)
    x, y = np.floor(pixels * (width / size[1], height / size[0])).astype(int).T
    within = (depth > 0) & (x >= 0) & (y >= 0) & (x < width) & (y < height)
    body[y[within], x[within]] = 1
    return cv2.morphologyEx(body, cv2.MORPH_CLOSE, _CLOSING) > 0, shrink
