"""Masks of the object in photographs, drawn once more from what all photographs together know of it.

The network decides in each photograph anew what stands out: it drops a part here and there, the cap of a bottle or a
tail. And GrabCut, which learns the colours of both sides from one picture, takes the shadow on which the object stands
for a part of it. The body that the masks leave together (`agreement.common_body`) has the part from the other
photographs, and lacks the shadow, which is no body. What is well inside it shows the colours of the object, what is
around it those of the floor and of the shadow there, in all photographs together. The edge lies near that of the body,
where both part at the least cost: by the ratio of their likelihoods, and the length of the outline.

Pictures are RGB, uint8, (H, W, 3); masks are Boolean, (H, W).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from scipy import ndimage

from neuma_lib.capture.agreement import common_body
from neuma_lib.capture.masks import box_of, component, grown, in_full, shrunk
from neuma_lib.capture.outlines import UNSEEN, cheapest
from neuma_lib.capture.tools import opencv

ROUNDS = 2
"""Times that body, colours and masks are found, each from better masks."""
BAND = 2.0
"""Distance from the body's edge within which the object's lies, in voxels."""
AROUND = 0.5
"""How far around the body colours of the floor are learned, in radii of its silhouette."""
_LONGEST = 800  # side of the photographs that are worked on [px]
_BINS = 32  # of each channel
_SPREAD = 1.0  # deviation of noise and exposure, in bins
_FLOOR = 1e-5  # share of a colour that was never seen


class _View(NamedTuple):
    """A photograph near the body: its part, pixels (h, w, 3), and what is certainly inside, and possibly."""

    size: tuple[int, int]
    box: tuple[slice, slice]
    pixels: np.ndarray
    certain: np.ndarray
    possible: np.ndarray


def redrawn_masks(
    pictures: Sequence[np.ndarray],
    masks: Sequence[np.ndarray],
    viewmats: np.ndarray,
    Ks: np.ndarray,
    kept: Sequence[bool] | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> list[np.ndarray]:
    """Masks of the object in N >= 2 photographs, from first ones.

    Args:
        pictures: the photographs.
        masks: first ones, most of which are of one object.
        viewmats, Ks: of the cameras, as for `common_body`.
        kept: whose masks are taken as they are, (N,); None: none.
        progress: called with photographs done and their number.

    Raises:
        InputError: no place in space lies in most of the masks.
    """
    masks, total = list(masks), ROUNDS * len(masks)
    for done in range(ROUNDS):
        body = common_body(masks, viewmats, Ks)
        seen = (body.seen(p.shape[:2], *camera) for p, camera in zip(pictures, zip(viewmats, Ks)))
        found = (_view(p, *each) for p, each in zip(pictures, seen))
        views = {i: view for i, view in enumerate(found) if view is not None}
        ratio = _likelihood_ratio(list(views.values()))
        for i, view in views.items():
            if kept is None or not kept[i]:
                drawn = _drawn(view, ratio, pictures[i].shape[:2])
                masks[i] = drawn if drawn.any() else masks[i]
            if progress:
                progress(done * len(masks) + i + 1, total)
    return masks


def _drawn(view: _View, ratio: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
    cost = (-2 * ratio[_bins(view.pixels)]).clip(-UNSEEN, UNSEEN)
    cost = np.where(view.certain, -UNSEEN, np.where(view.possible, cost, UNSEEN))
    inside = in_full(component(cheapest(cost, view.pixels.astype(np.float32))), view.box, view.size)
    cv2 = opencv()
    return cv2.resize(inside.astype(np.float32), shape[::-1], interpolation=cv2.INTER_LINEAR) > 0.5


def _view(picture: np.ndarray, body: np.ndarray, voxel: float) -> _View | None:
    """None: the body is not in the picture."""
    cv2 = opencv()
    height, width = body.shape
    scale = min(1.0, _LONGEST / max(height, width))
    size = round(width * scale), round(height * scale)
    likely = cv2.resize(body.astype(np.float32), size, interpolation=cv2.INTER_AREA) > 0.5
    if not likely.any():
        return None
    band = max(2, round(BAND * scale * voxel))
    box = box_of(likely, band + round(AROUND * float(np.sqrt(likely.sum() / np.pi))))
    pixels = cv2.resize(picture, size, interpolation=cv2.INTER_AREA)[box]
    return _View(likely.shape, box, pixels, shrunk(likely, band)[box], grown(likely, band)[box])


def _bins(pixels: np.ndarray) -> tuple[np.ndarray, ...]:
    return tuple(np.moveaxis(pixels.astype(int) * _BINS // 256, -1, 0))


def _likelihood_ratio(views: Sequence[_View]) -> np.ndarray:
    """Logarithm of the object's share of a colour over that of what is around it, by bins of the three channels."""
    logs = []
    for parts in ([v.pixels[v.certain] for v in views], [v.pixels[~v.possible] for v in views]):
        counts = np.zeros((_BINS,) * 3)
        np.add.at(counts, _bins(np.concatenate(parts)), 1)
        shares = ndimage.gaussian_filter(counts / max(counts.sum(), 1), _SPREAD, mode="nearest")
        logs.append(np.log(shares + _FLOOR / _BINS))
    return logs[0] - logs[1]
