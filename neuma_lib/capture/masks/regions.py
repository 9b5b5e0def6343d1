"""Operations on masks (components, morphology, mattes, overlap) and checks of their plausibility.

Pictures are RGB, uint8, (H, W, 3). Masks are Boolean, (H, W). Positions are (x, y) [px], pixel centres at +0.5.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from PIL import Image
from scipy import ndimage

from neuma_lib.capture.frames import Frame
from neuma_lib.capture.tools import opencv
from neuma_lib.errors import InputError
from neuma_lib.io.files import existing, read_regular, reading
from neuma_lib.io.images import open_image

_MIN_AREA = 2e-5  # minimum area of an object, as share of the picture
MAX_MOVING = 0.1
"""Tolerated share of the picture outside object and shadows that differs from the background."""
MAX_JUMP = 1.0
"""Tolerated relative change of a mask's area between frames of free flight. 0.03 is usual in sharp pictures, 0.3 with
blur or a background of similar colour. A larger one means that something else is in the mask."""
_EDGE = 0.7  # standard deviation of the blur that softens a mask's edge [px]
_MAX_AREA_RATIO = 3.0  # maximum ratio of areas of the same object from frame to frame
_GRABCUT_ROUNDS = 4


def centroid(mask: np.ndarray) -> np.ndarray:
    """Mean position (x, y) of a mask, (2,). NaN if empty."""
    y, x = np.nonzero(mask)
    return np.array([x.mean(), y.mean()]) + 0.5 if len(x) else np.full(2, np.nan)


def radius_of(mask: np.ndarray) -> float:
    """Radius of a disc with the area of a mask [px]."""
    return float(np.sqrt(mask.sum() / np.pi))


def iou(a: np.ndarray, b: np.ndarray) -> float:
    """Intersection over union of two masks. 1 if both are empty."""
    union = np.logical_or(a, b).sum()
    return float(np.logical_and(a, b).sum() / union) if union else 1.0


def area_jumps(areas: np.ndarray) -> np.ndarray:
    """Absolute change of the area (T,) from frame to frame, relative to the smaller one, (T - 1,)."""
    areas = np.asarray(areas, float)
    return np.abs(np.diff(areas)) / np.maximum(np.minimum(areas[1:], areas[:-1]), 1)


def matted(pixels: np.ndarray, mask: np.ndarray) -> np.ndarray:
    """Matte of the object with a soft edge, straight-alpha RGBA (H, W, 4), uint8.

    Colours outside, and within two pixels of the edge, are those of the nearest pixel further inside, since pixels at
    the edge also show the background.
    """
    cv2 = opencv()
    alpha = cv2.GaussianBlur(mask.astype(np.float32), (0, 0), _EDGE)
    inside = ndimage.binary_erosion(mask, iterations=2, border_value=1)
    if not inside.any():
        inside = mask
    colours = pixels
    if inside.any():
        row, column = ndimage.distance_transform_edt(~inside, return_distances=False, return_indices=True)
        colours = pixels[row, column]
    return np.dstack([colours, np.rint(255 * alpha).astype(np.uint8)])


def overlay(frame: Frame, mask: np.ndarray) -> Frame:
    """A frame with darkened background and the mask outlined in red, for `neuma_lib.capture.frames.contact_sheet`."""
    pixels = np.where(mask[..., None], frame.pixels, frame.pixels // 2)
    width = max(1, frame.pixels.shape[1] // 400)  # visible on a contact sheet
    pixels[ndimage.binary_dilation(mask, iterations=width) & ~mask] = (255, 0, 0)
    return frame._replace(pixels=pixels.astype(np.uint8))


def read_mask(
    path: str | Path, size: tuple[int, int], labels: Mapping[str, int | str] | None = None
) -> np.ndarray:
    """Read a mask of the user: opaque pixels of a picture with alpha, else pixels brighter than half, (H, W).

    Args:
        path: PNG, JPEG or WebP.
        size: width and height of its picture [px].
        labels: of several bodies by name, grey values, palette indices or colours. The mask then has the number of the
            body in each pixel, from 1, or 0 where the picture is black or transparent, uint8.

    Raises:
        InputError: missing, damaged, of another size, or empty; a label of no body.
    """
    content = read_regular(existing(path, "Put the mask there, or remove it from the settings"))
    with open_image(content, path) as image, reading(path, "a mask"):
        image.load()
        has_alpha = "A" in image.mode or "transparency" in image.info
        alpha = np.asarray(image.convert("RGBA").getchannel("A"))
        mask = (alpha if has_alpha else np.asarray(image.convert("L"))) > 127
        if labels:
            mask = _numbers(image, labels, path) * (alpha > 127).astype(np.uint8)
    if (
        mask.shape == tuple(size) != mask.shape[::-1]
    ):  # of a picture that is stored turned, see `read_picture`
        mask = np.rot90(mask)
    if mask.shape[::-1] != tuple(size):
        raise InputError(
            path,
            f"the mask is {mask.shape[1]}x{mask.shape[0]}, its picture {size[0]}x{size[1]}",
            "Save the mask at the size of its picture",
        )
    if not mask.any():
        raise InputError(
            path,
            "the mask is empty, it has no white or opaque pixel",
            "Draw the object in white, or delete the file if its picture does not show the object",
        )
    return mask


def _numbers(image: Image.Image, labels: Mapping[str, int | str], path: str | Path) -> np.ndarray:
    """Number of the body of each pixel, in the order of the labels, from 1, (H, W), uint8."""
    coloured = any(isinstance(label, str) for label in labels.values())
    if coloured:
        values = np.asarray(image.convert("RGB"), np.uint32) @ np.array([1 << 16, 1 << 8, 1], np.uint32)
    else:
        values = np.asarray(image if image.mode == "P" else image.convert("L"), np.uint32)
    numbers = np.zeros(values.shape, np.uint8)
    for k, label in enumerate(labels.values(), 1):
        numbers[values == (int(label[1:], 16) if isinstance(label, str) else label)] = k
    unknown, counts = np.unique(values[(numbers == 0) & (values != 0)], return_counts=True)
    if len(unknown):
        worst = int(unknown[counts.argmax()])
        raise InputError(
            path,
            f"{counts.sum()} pixels have labels of no body, most of them {f'#{worst:06x}' if coloured else worst}; the"
            f" bodies have {', '.join(f'{label} ({name})' for name, label in labels.items())}",
            "Save the labels as PNG without smoothed edges, or correct `bodies` in capture.yaml",
        )
    return numbers


def component(
    strong: np.ndarray, place: np.ndarray | None = None, area: float | None = None, gate: float | None = None
) -> np.ndarray:
    """The connected component nearest to a position and an area, with holes filled. The largest if neither is given.

    With a gate [px], components whose centre is farther from the position, or whose area differs by more than
    `_MAX_AREA_RATIO`, are excluded. Empty if there is none.
    """
    labels, sizes, middles = parts_of(strong)
    enough = np.flatnonzero(sizes >= min_area(strong))
    if len(enough) == 0:
        return np.zeros_like(strong)
    score = np.log(sizes[enough])
    if area is not None:
        score = -np.abs(score - np.log(area))
    if place is not None:
        reach = np.sqrt((sizes[enough] if area is None else area) / np.pi)
        distance = np.linalg.norm(middles[enough] - place, axis=1)
        score = score - (distance / (2 * reach)) ** 2
        if gate is not None:
            other_size = np.abs(np.log(sizes[enough] / area)) > np.log(_MAX_AREA_RATIO)
            score[(distance > gate) | other_size] = -np.inf
    if not np.isfinite(score).any():
        return np.zeros_like(strong)
    return ndimage.binary_fill_holes(labels == enough[np.argmax(score)] + 1)


def parts_of(mask: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Labels (H, W) of the connected components, from 1, their areas (N,) [px] and centres (N, 2)."""
    _, labels, stats, middles = opencv().connectedComponentsWithStats(mask.view(np.uint8))
    return labels, stats[1:, -1].astype(float), middles[1:] + 0.5


def grabcut(
    image: np.ndarray, sure: np.ndarray, foreground: np.ndarray, background: np.ndarray
) -> np.ndarray:
    """Largest component of GrabCut from pixels that are certainly, probably and certainly not the object, filled."""
    cv2 = opencv()
    labels = np.full(image.shape[:2], cv2.GC_PR_BGD, np.uint8)
    labels[foreground], labels[background], labels[sure] = cv2.GC_PR_FGD, cv2.GC_BGD, cv2.GC_FGD
    inside = np.isin(labels, (cv2.GC_FGD, cv2.GC_PR_FGD))
    # GrabCut fits colour models to both sides, so each needs some pixels.
    if min(inside.sum(), (~inside).sum()) >= 10:
        cv2.setRNGSeed(0)
        models = np.zeros((1, 65)), np.zeros((1, 65))
        cv2.grabCut(image, labels, None, *models, _GRABCUT_ROUNDS, cv2.GC_INIT_WITH_MASK)
        inside = np.isin(labels, (cv2.GC_FGD, cv2.GC_PR_FGD))
    return component(inside)


def grown(mask: np.ndarray, by: int) -> np.ndarray:
    return opencv().dilate(mask.view(np.uint8), cross(), iterations=by).view(bool)


def shrunk(mask: np.ndarray, by: int) -> np.ndarray:
    """Erode a mask by some pixels. The picture's border counts as an edge."""
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


def min_area(picture: np.ndarray) -> float:
    return max(9, _MIN_AREA * picture.size)


def whole(mask: np.ndarray) -> bool:
    """Whether a mask is not empty and does not touch the picture's border."""
    return bool(mask.any() and not cut_off(mask))


def cut_off(mask: np.ndarray) -> bool:
    return bool(mask[[0, -1]].any() or mask[:, [0, -1]].any())


def check_not_empty(mask: np.ndarray, name: str | Path, frame: int | None = None) -> None:
    """Raises InputError if a mask has no pixel."""
    if not mask.any():
        raise InputError(
            _where(name, frame),
            "the mask is empty, the object was not detected",
            "Cut the video to the frames that show it, film against a background of another colour, or provide a mask",
        )


def check_background(moving: np.ndarray, name: str | Path) -> None:
    """Raises InputError if a share of more than `MAX_MOVING` of a picture moves outside the object, (T,)."""
    worst = int(np.argmax(moving))
    if moving[worst] > MAX_MOVING:
        raise InputError(
            _where(name, worst),
            f"the background moves: outside the object, {moving[worst]:.0%} of the picture differ from the empty scene,"
            f" the limit is {MAX_MOVING:.0%}",
            "Fix the camera, take the empty picture from the same position, lock focus and exposure, and keep hands out"
            " of the picture",
        )


def check_flight(masks: np.ndarray, name: str | Path, frames: Sequence[int]) -> np.ndarray:
    """Check the masks of free flight: not empty, not at the picture's border, without sudden changes of area.

    Args:
        masks: of the whole video, (T, H, W).
        name: of the file for messages.
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
                _where(name, i),
                "the object leaves the picture",
                "Leave this frame out, or film from farther away",
            )
    jumps = area_jumps(masks[list(frames)].sum(axis=(1, 2)))
    if len(jumps) and jumps.max() > MAX_JUMP:
        worst = int(np.argmax(jumps))
        raise InputError(
            _where(name, frames[worst + 1]),
            f"the mask's area changes by {jumps[worst]:.0%} from the previous frame in free flight, the limit is"
            f" {MAX_JUMP:.0%}",
            "Check the contact sheet for a hand, a shadow or the background in the mask, leave such frames out, or"
            " provide masks",
        )
    return jumps


def _where(name: str | Path, frame: int | None) -> str:
    return f"{name}" if frame is None else f"{name}, frame {frame}"
