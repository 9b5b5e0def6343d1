"""Whether masks of several views are of one thing: each against the body that the views together leave.

Voxels that lie in nearly all masks make the body (a visual hull that bears some bad masks); seen by a camera, it should
cover the camera's mask. A mask with the floor in it, of another object, or of a camera with a wrong pose, does not fit.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from neuma_lib.capture.masks import centroid, iou
from neuma_lib.capture.tools import opencv
from neuma_lib.errors import InputError

LEAST_AGREEMENT = 0.7
"""Least IoU of a mask with the body of all that is not doubtful."""
LEAST_SAME = 0.5
"""Least IoU with which cameras that film at one time can be said to film one object."""
LEAST_SHARES = (0.8, 0.95)
"""Share of the views which see a voxel that must have it in their masks: of all views, and without the doubtful."""
_CUT_OFF = 0.7  # part of the most views of a voxel below which it is one that many pictures cut off
_MISSES = 2  # masks that may lack such a voxel, one of each five; of so few a share would let none
_VOXELS = (24, 64)  # along a side of the cube, at first and then
_MARGIN = 1.6  # half side of the first cube, in radii of the masks
_CLOSING = np.ones((3, 3), np.uint8)


@dataclass(frozen=True, eq=False)
class CommonBody:
    """What several views leave of a cube of space.

    Attributes:
        points: middles of its voxels, (P, 3).
        voxel: their side.
        agreement: IoU of each mask with the body as seen from there, (N,).
    """

    points: np.ndarray
    voxel: float
    agreement: np.ndarray

    def seen(self, size: tuple[int, int], viewmat: np.ndarray, K: np.ndarray) -> tuple[np.ndarray, float]:
        """The body in a picture, known to about half a voxel, (H, W), and how large a voxel is there [px].

        Args:
            size: height and width of the picture [px].
        """
        body, shrink = _drawn(self.points, self.voxel, size, viewmat, K)
        large = opencv().resize(body.astype(np.float32), size[::-1], interpolation=opencv().INTER_LINEAR)
        return large > 0.5, 1 / shrink


def agreement(masks: Sequence[np.ndarray], viewmats: np.ndarray, Ks: np.ndarray) -> np.ndarray:
    """IoU of each mask with the body that all of them leave (`common_body`), (N,)."""
    return common_body(masks, viewmats, Ks).agreement


def common_body(masks: Sequence[np.ndarray], viewmats: np.ndarray, Ks: np.ndarray) -> CommonBody:
    """The body that masks of several views leave together.

    The body is drawn at the size of its voxels, so that an IoU is known to some hundredths.

    Args:
        masks: of N >= 2 pinhole cameras, Boolean, (H, W), of any sizes, none empty.
        viewmats: world to camera, OpenCV axes, (N, 4, 4).
        Ks: [px], pixel centres at +0.5, (N, 3, 3).

    Raises:
        InputError: no place in space lies in most of the masks.
    """
    centres = np.stack([centroid(mask) for mask in masks])
    middle = nearest_point(centres, viewmats, Ks)
    depths = viewmats[:, 2, :3] @ middle + viewmats[:, 2, 3]
    radii = np.array([np.sqrt(mask.sum() / np.pi) for mask in masks]) * depths / Ks[:, 0, 0]
    if not (depths > 0).any():
        raise InputError(_APART)
    reach = _MARGIN * 2 * float(np.median(radii[depths > 0]))
    views = list(zip(masks, viewmats, Ks))
    chosen = views
    for share in LEAST_SHARES:
        points, voxel = _body(chosen, middle - reach, middle + reach, share)
        found = np.array([_agreed(points, voxel, *view) for view in views])
        chosen = [view for view, agreed in zip(views, found) if agreed >= LEAST_AGREEMENT]
        if len(chosen) < 2:
            break
    return CommonBody(points, voxel, found)


def check_one_object(found: Sequence[float], cameras: Sequence[str], name: str) -> None:
    """Raises InputError where the `agreement` of cameras' masks at one time says that they show different things."""
    worst = int(np.argmin(found))
    if found[worst] < LEAST_SAME:
        raise InputError(
            f"{name}: the cameras do not show one object where it rests, the body that fits all masks fills that of"
            f" {cameras[worst]} with an IoU of {found[worst]:.2f}: are the videos of one throw and of one object, have"
            f" the cameras stood still, and is a hand or a shadow in a mask? Look at the contact sheets"
        )


_APART = (
    "no place in space lies in most of the masks: they are not of one object, or the cameras have moved since their"
    " poses were found; look at the contact sheets of the masks"
)


def nearest_point(centres: np.ndarray, viewmats: np.ndarray, Ks: np.ndarray) -> np.ndarray:
    """The point nearest to the rays through places in the pictures; weights make single bad ones harmless."""
    rays = np.concatenate(
        [(centres - Ks[:, :2, 2]) / Ks[:, [0, 1], [0, 1]], np.ones((len(centres), 1))], axis=1
    )
    rays = np.einsum("nji,nj->ni", viewmats[:, :3, :3], rays / np.linalg.norm(rays, axis=1, keepdims=True))
    eyes = -np.einsum("nji,nj->ni", viewmats[:, :3, :3], viewmats[:, :3, 3])
    across = np.eye(3) - rays[:, :, None] * rays[:, None]
    weights = np.ones(len(rays))
    for _ in range(20):
        normal = (weights[:, None, None] * across).sum(axis=0) + 1e-9 * np.eye(3)
        point = np.linalg.solve(normal, np.einsum("n,nij,nj->i", weights, across, eyes))
        off = np.linalg.norm(np.einsum("nij,nj->ni", across, point - eyes), axis=1)
        weights = 1 / np.maximum(off, 1e-3 * np.median(np.linalg.norm(point - eyes, axis=1)))
    return point


def _projected(points: np.ndarray, viewmat: np.ndarray, K: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Pixels (P, 2), and depth (P,)."""
    seen = points @ viewmat[:3, :3].T + viewmat[:3, 3]
    return (seen[:, :2] / np.maximum(seen[:, 2:], 1e-9)) * K[[0, 1], [0, 1]] + K[:2, 2], seen[:, 2]


def _body(
    views: Sequence[tuple[np.ndarray, np.ndarray, np.ndarray]],
    lower: np.ndarray,
    upper: np.ndarray,
    share: float,
) -> tuple[np.ndarray, float]:
    """Voxels' middles (P, 3) that lie in a share of the masks, and their side."""
    for count in _VOXELS:
        voxel = float((upper - lower).max()) / count
        ticks = [lower[k] + (np.arange(np.ceil((upper - lower)[k] / voxel)) + 0.5) * voxel for k in range(3)]
        points = np.stack(np.meshgrid(*ticks, indexing="ij"), axis=-1).reshape(-1, 3)
        seen, inside = np.zeros((2, len(points)), int)
        for mask, viewmat, K in views:
            height, width = mask.shape
            pixels, depth = _projected(points, viewmat, K)
            within = (depth > 0) & ((pixels >= 0) & (pixels < (width, height))).all(axis=1)
            x, y = pixels[within].astype(int).T
            seen[within] += 1
            inside[np.flatnonzero(within)[mask[y, x]]] += 1
        # What few cameras see, they cannot make a body of.
        missed = np.where(seen < _CUT_OFF * seen.max(), np.minimum(_MISSES, seen // 5), 0)
        kept = (inside >= share * seen) | (seen - inside <= missed)
        points = points[(seen >= max(2, 0.25 * seen.max())) & kept]
        if len(points) == 0:
            raise InputError(_APART)
        lower, upper = points.min(axis=0) - 1.5 * voxel, points.max(axis=0) + 1.5 * voxel
    return points, voxel


def _agreed(points: np.ndarray, voxel: float, mask: np.ndarray, viewmat: np.ndarray, K: np.ndarray) -> float:
    """IoU of a mask and of the body as its camera sees it."""
    cv2 = opencv()
    body, _ = _drawn(points, voxel, mask.shape, viewmat, K)
    small = cv2.resize(mask.astype(np.float32), body.shape[::-1], interpolation=cv2.INTER_AREA) > 0.5
    return iou(small, body)


def _drawn(
    points: np.ndarray, voxel: float, size: tuple[int, int], viewmat: np.ndarray, K: np.ndarray
) -> tuple[np.ndarray, float]:
    """The body as a camera sees it, in pixels as large as the voxels, and by how much the picture (H, W) shrinks."""
    cv2 = opencv()
    pixels, depth = _projected(points, viewmat, K)
    shrink = min(1.0, float(np.median(depth)) / (voxel * K[0, 0])) if (depth > 0).all() else 1.0
    width, height = (max(1, round(shrink * n)) for n in size[::-1])
    body = np.zeros((height, width), np.uint8)
    x, y = np.floor(pixels * (width / size[1], height / size[0])).astype(int).T
    within = (depth > 0) & (x >= 0) & (y >= 0) & (x < width) & (y < height)
    body[y[within], x[within]] = 1
    return cv2.morphologyEx(body, cv2.MORPH_CLOSE, _CLOSING) > 0, shrink
