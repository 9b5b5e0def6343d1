"""Masks, and what is done with them: parts, edges, mattes, overlaps, and whether they can be right.

Pictures are RGB, uint8, (H, W, 3); masks are Boolean, (H, W); places are (x, y) [px], pixel centres at +0.5.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from scipy import ndimage

from neuma_lib.capture.frames import Frame
from neuma_lib.capture.tools import opencv
from neuma_lib.errors import InputError
from neuma_lib.io.files import existing, reading
from neuma_lib.io.images import open_image

LEAST_AREA = 2e-5
"""Part of the picture that an object covers at least."""
MOST_MOVING = 0.1
"""Part of the picture outside object and shadows that may differ from the plate."""
MOST_JUMP = 1.0
"""Change of a mask's area from one frame of free flight to the next that is an error: something else has come in. In
sharp pictures 0.03 is usual; blur and a ground of a like colour make it 0.3."""
EDGE = 0.7
"""Deviation of the blur that makes a mask's edge soft [px]."""
RATIO = 3.0
"""Of areas from frame to frame that may be the same object's, at most."""
_GRABCUT_ROUNDS = 4


def centroid(mask: np.ndarray) -> np.ndarray:
    """Mean place (x, y) of a mask, (2,); NaN where it is empty."""
    y, x = np.nonzero(mask)
    return np.array([x.mean(), y.mean()]) + 0.5 if len(x) else np.full(2, np.nan)


def iou(a: np.ndarray, b: np.ndarray) -> float:
    """Intersection over union of two masks; 1 where both are empty."""
    union = np.logical_or(a, b).sum()
    return float(np.logical_and(a, b).sum() / union) if union else 1.0


def area_jumps(areas: np.ndarray) -> np.ndarray:
    """|Change| of the area (T,) from frame to frame, as a part of the smaller one, (T - 1,)."""
    areas = np.asarray(areas, float)
    return np.abs(np.diff(areas)) / np.maximum(np.minimum(areas[1:], areas[:-1]), 1)


def matted(pixels: np.ndarray, mask: np.ndarray) -> np.ndarray:
    """The object with a soft edge, straight-alpha RGBA (H, W, 4), uint8.

    Colours within two pixels of the edge, and outside, are those of the nearest pixel further in: a pixel at the edge
    shows the floor, too, which must not bleed into the object.
    """
    cv2 = opencv()
    alpha = cv2.GaussianBlur(mask.astype(np.float32), (0, 0), EDGE)
    inside = ndimage.binary_erosion(mask, iterations=2, border_value=1)
    if not inside.any():
        inside = mask
    colours = pixels
    if inside.any():
        row, column = ndimage.distance_transform_edt(~inside, return_distances=False, return_indices=True)
        colours = pixels[row, column]
    return np.dstack([colours, np.rint(255 * alpha).astype(np.uint8)])


def overlay(frame: Frame, mask: np.ndarray) -> Frame:
    """A frame with the ground darkened and the mask outlined in red, for `neuma_lib.capture.frames.contact_sheet`."""
    shown = np.where(mask[..., None], frame.pixels, frame.pixels // 2)
    width = max(1, frame.pixels.shape[1] // 400)  # to be seen on a contact sheet
    shown[ndimage.binary_dilation(mask, iterations=width) & ~mask] = (255, 0, 0)
    return frame._replace(pixels=shown.astype(np.uint8))


def read_mask(path: str | Path, size: tuple[int, int]) -> np.ndarray:
    """A mask of the user's: opaque where the picture has transparency, else where it is brighter than half, (H, W).

    Args:
        path: PNG, JPEG or WebP.
        size: width and height of the picture that it belongs to [px].

    Raises:
        InputError: missing, damaged, of another size, or empty.
    """
    content = existing(path, "put the mask there, or remove it from the settings").read_bytes()
    with open_image(content, path) as image, reading(path, "a mask"):
        image.load()
        clear = "A" in image.mode or "transparency" in image.info
        mask = np.asarray(image.convert("RGBA").getchannel("A") if clear else image.convert("L")) > 127
    if mask.shape[::-1] != tuple(size):
        raise InputError(
            f"{path} is {mask.shape[1]}x{mask.shape[0]}, its picture {size[0]}x{size[1]}: make the mask at that size"
        )
    check_not_empty(mask, path)
    return mask


def component(
    strong: np.ndarray, place: np.ndarray | None = None, area: float | None = None, gate: float | None = None
) -> np.ndarray:
    """The connected part that is nearest to a place and to an area; the largest where neither is known.

    With a gate [px], a part whose middle is farther from the place, or whose area is another by more than `RATIO`, is
    not taken.
    """
    labels, sizes, middles = parts_of(strong)
    enough = np.flatnonzero(sizes >= least_area(strong))
    if len(enough) == 0:
        return np.zeros_like(strong)
    score = np.log(sizes[enough])
    if area is not None:
        score = -np.abs(score - np.log(area))
    if place is not None:
        reach = np.sqrt((sizes[enough] if area is None else area) / np.pi)
        off = np.linalg.norm(middles[enough] - place, axis=1)
        score = score - (off / (2 * reach)) ** 2
        if gate is not None:
            score[(off > gate) | (np.abs(np.log(sizes[enough] / area)) > np.log(RATIO))] = -np.inf
    if not np.isfinite(score).any():
        return np.zeros_like(strong)
    return ndimage.binary_fill_holes(labels == enough[np.argmax(score)] + 1)


def parts_of(mask: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Labels (H, W) of the connected parts, from 1, their areas (N,) [px] and their middles (N, 2)."""
    _, labels, stats, middles = opencv().connectedComponentsWithStats(mask.view(np.uint8))
    return labels, stats[1:, -1].astype(float), middles[1:] + 0.5


def grabcut(
    image: np.ndarray, sure: np.ndarray, foreground: np.ndarray, background: np.ndarray
) -> np.ndarray:
    """GrabCut from what is certainly the object, probably the object, and certainly not; its largest part, filled."""
    cv2 = opencv()
    labels = np.full(image.shape[:2], cv2.GC_PR_BGD, np.uint8)
    labels[foreground], labels[background], labels[sure] = cv2.GC_PR_FGD, cv2.GC_BGD, cv2.GC_FGD
    inside = np.isin(labels, (cv2.GC_FGD, cv2.GC_PR_FGD))
    # GrabCut fits colours to both sides: it needs some pixels of each.
    if min(inside.sum(), (~inside).sum()) >= 10:
        cv2.setRNGSeed(0)
        models = np.zeros((1, 65)), np.zeros((1, 65))
        cv2.grabCut(image, labels, None, *models, _GRABCUT_ROUNDS, cv2.GC_INIT_WITH_MASK)
        inside = np.isin(labels, (cv2.GC_FGD, cv2.GC_PR_FGD))
    return component(inside)


def grown(mask: np.ndarray, by: int) -> np.ndarray:
    return opencv().dilate(mask.view(np.uint8), cross(), iterations=by).view(bool)


def shrunk(mask: np.ndarray, by: int) -> np.ndarray:
    """What is farther than some pixels from an edge; the picture's border is one."""
    return opencv().erode(mask.view(np.uint8), cross(), iterations=by, borderValue=0).view(bool)


def opened(mask: np.ndarray) -> np.ndarray:
    cv2 = opencv()
    return cv2.morphologyEx(mask.view(np.uint8), cv2.MORPH_OPEN, cross()).view(bool)


def cross() -> np.ndarray:
    cv2 = opencv()
    return cv2.getStructuringElement(cv2.MORPH_CROSS, (3, 3))


def box_of(mask: np.ndarray, margin: int) -> tuple[slice, slice]:
    rows, columns = (np.flatnonzero(mask.any(axis=axis)) for axis in (1, 0))
    return tuple(slice(max(0, a[0] - margin), a[-1] + 1 + margin) for a in (rows, columns))


def in_full(part: np.ndarray, box: tuple[slice, slice], shape: tuple[int, int]) -> np.ndarray:
    full = np.zeros(shape, bool)
    full[box] = part
    return full


def least_area(picture: np.ndarray) -> float:
    return max(9, LEAST_AREA * picture.size)


def whole(mask: np.ndarray) -> bool:
    """Whether there is something, and the picture's border does not cut it."""
    return bool(mask.any() and not cut_off(mask))


def cut_off(mask: np.ndarray) -> bool:
    return bool(mask[[0, -1]].any() or mask[:, [0, -1]].any())


def check_not_empty(mask: np.ndarray, name: str | Path, frame: int | None = None) -> None:
    """Raises InputError where a mask has no pixel."""
    if not mask.any():
        raise InputError(
            f"{_where(name, frame)}: the mask is empty, the object was not found: cut the video to the frames that"
            f" show it, film against a ground of another colour, or give a mask of your own"
        )


def check_background(moving: np.ndarray, name: str | Path) -> None:
    """Raises InputError where more than `MOST_MOVING` of a picture moves besides the object, (T,)."""
    worst = int(np.argmax(moving))
    if moving[worst] > MOST_MOVING:
        raise InputError(
            f"{_where(name, worst)}: the background moves, {moving[worst]:.0%} of the picture differ from the empty"
            f" one besides the object: fix the camera, take the empty picture from the same place, lock focus and"
            f" exposure, and keep hands out of the picture"
        )


def check_flight(masks: np.ndarray, name: str | Path, frames: Sequence[int]) -> np.ndarray:
    """Check the masks of free flight: none empty, none at the picture's border, no sudden change of area.

    Args:
        masks: of the whole video, (T, H, W).
        name: of the file, for messages.
        frames: numbers of the frames before contact.

    Returns:
        `area_jumps` of these frames.

    Raises:
        InputError: names file and frame.
    """
    for i in frames:
        check_not_empty(masks[i], name, i)
        if cut_off(masks[i]):
            raise InputError(
                f"{_where(name, i)}: the object leaves the picture: leave this frame out, or film from farther away"
            )
    jumps = area_jumps(masks[list(frames)].sum(axis=(1, 2)))
    if len(jumps) and jumps.max() > MOST_JUMP:
        worst = int(np.argmax(jumps))
        raise InputError(
            f"{_where(name, frames[worst + 1])}: the mask's area changes by {jumps[worst]:.0%} from the frame before,"
            f" in free flight: look at the contact sheet; a hand, a shadow or a ground of the object's colour may be"
            f" in the mask; leave such frames out, or give masks of your own"
        )
    return jumps


def _where(name: str | Path, frame: int | None) -> str:
    return f"{name}" if frame is None else f"{name}, frame {frame}"
