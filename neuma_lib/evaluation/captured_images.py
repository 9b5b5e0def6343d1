"""How alike a prediction and the video of a real throw are: the object alone, and the whole picture.

**The object** is cut out: predicted and filmed colours over white, on the bounding box of both
(`neuma_lib.evaluation.image_metrics`). **The whole picture** is the frame as it was filmed, without the lens's
distortion, against the prediction laid over the picture of the empty scene. That background is nearly the same in both,
so its PSNR and SSIM are high whatever is predicted and only compare methods on one video; shadows and reflections of
the object are in the frame alone.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor

from neuma_lib.errors import InputError
from neuma_lib.evaluation.image_metrics import MEASURES, image_metrics, psnr, ssim
from neuma_lib.evaluation.lpips import LPIPS
from neuma_lib.evaluation.reports import as_csv

SCENE = "scene_"
"""What the names of measures of the whole picture begin with."""
WHOLE = ("psnr", "ssim", "lpips_alex")
"""Measures of the whole picture; VGG would take a second for each on a core."""
COLUMNS = (*MEASURES, "iou", *(f"{SCENE}{name}" for name in WHOLE))
"""Measures of a frame by name; ``iou`` is that of predicted and filmed mask."""
DIGITS = {"psnr": 2, "ssim": 4, "lpips_vgg": 4, "lpips_alex": 4, "iou": 4}
OPAQUE = 0.5
"""Opacity from which a pixel belongs to a mask."""


def laid_over(colours: Tensor, alpha: Tensor, background: Tensor | float) -> Tensor:
    """Colours over black (..., 3) with their opacity (...) over another background (..., 3)."""
    return colours + (1 - alpha[..., None]) * background


def exposed(plate: np.ndarray, gain: Sequence[float], offset: Sequence[float]) -> np.ndarray:
    """The picture of the empty scene (H, W, 3), uint8, at the exposure of a frame, in [0, 1].

    Args:
        gain, offset: of each channel, (3,), so that frame = gain * plate + offset [0 to 255].
    """
    return np.clip(plate * np.asarray(gain, np.float32) + np.asarray(offset, np.float32), 0, 255) / 255


def captured_metrics(
    colours: Tensor,
    alpha: Tensor,
    matte: Tensor,
    picture: Tensor,
    empty: Tensor,
    networks: Mapping[str, LPIPS],
    margin: float,
) -> dict[str, float]:
    """Measures of one frame, by the names of `COLUMNS` of which there are networks.

    Args:
        colours: predicted, over black, in [0, 1], shape (H, W, 3).
        alpha: their opacity, (H, W).
        matte: the object as filmed, straight-alpha RGBA in [0, 1], (H, W, 4).
        picture: the frame as filmed, in [0, 1], (H, W, 3).
        empty: the empty scene at the frame's exposure, likewise.
        networks, margin: as of `image_metrics`.

    Raises:
        InputError: shapes differ, or the object is nowhere.
    """
    if not (colours.shape == picture.shape == empty.shape == matte[..., :3].shape):
        shapes = [tuple(each.shape) for each in (colours, picture, empty, matte)]
        raise InputError(f"image measures: prediction, frame, empty scene and matte differ in size: {shapes}")
    mask = matte[..., 3]
    filmed = laid_over(matte[..., :3] * mask[..., None], mask, 1.0)
    found = image_metrics(laid_over(colours, alpha, 1.0), alpha, filmed, mask, networks, margin)
    pair = [each.clamp(0, 1) for each in (laid_over(colours, alpha, empty), picture)]
    arrays = [each.cpu().numpy() for each in pair]
    planes = [each.permute(2, 0, 1)[None] for each in pair]
    found["iou"] = overlap(alpha > OPAQUE, mask > OPAQUE)
    found |= {f"{SCENE}psnr": psnr(*arrays), f"{SCENE}ssim": ssim(*arrays)}
    networks = {name: network for name, network in networks.items() if f"lpips_{name}" in WHOLE}
    return found | {f"{SCENE}lpips_{name}": float(network(*planes)) for name, network in networks.items()}


def overlap(a: Tensor, b: Tensor) -> float:
    """Intersection over union of two masks, 1 where both are empty."""
    union = int((a | b).sum())
    return int((a & b).sum()) / union if union else 1.0


def averaged(frames: Sequence[Mapping[str, float]]) -> dict[str, float]:
    """Mean of each measure over frames. Raises InputError where there are none."""
    if not frames:
        raise InputError("image measures: there are no frames to average")
    return {name: float(np.mean([frame[name] for frame in frames])) for name in frames[0]}


def image_rows(found: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """Rows of the table: each camera of each throw, then all frames that were learned from, and all that were not.

    Args:
        found: of each method, throw and camera ``method``, ``title``, ``throw``, ``camera``, ``learned`` (whether the
            law was learned from these frames) and ``frames``, a list of measures.

    Returns:
        ``method``, ``title``, ``throw``, ``camera``, ``learned``, ``frames`` (their number) and the measures; throw and
        camera are "all" in the sums.
    """
    rows = [_row(entry, entry["frames"]) for entry in found]
    for method in dict.fromkeys(entry["method"] for entry in found):
        for learned in (True, False):
            part = [entry for entry in found if (entry["method"], entry["learned"]) == (method, learned)]
            if part:
                whole = {**part[0], "throw": "all", "camera": "all"}
                rows.append(_row(whole, [frame for entry in part for frame in entry["frames"]]))
    return rows


def _row(entry: Mapping[str, Any], frames: Sequence[Mapping[str, float]]) -> dict[str, Any]:
    keys = ("method", "title", "throw", "camera", "learned")
    return {**{key: entry[key] for key in keys}, "frames": len(frames), **averaged(frames)}


def images_csv(rows: Sequence[Mapping[str, Any]]) -> str:
    """The rows of `image_rows` as CSV."""
    heads = ("method", "throw", "camera", "frames were", "frames")
    lines = [
        (
            row["method"],
            row["throw"],
            row["camera"],
            "learned from" if row["learned"] else "held out",
            row["frames"],
            *(f"{row[name]:.{DIGITS[name.removeprefix(SCENE)]}f}" for name in COLUMNS),
        )
        for row in rows
    ]
    return as_csv([(*heads, *COLUMNS), *lines])


def error_picture(predicted: np.ndarray, filmed: np.ndarray, factor: float = 3.0) -> np.ndarray:
    """Where two pictures (..., 3) in [0, 1] differ: white where they agree, darker the more they do not."""
    difference = np.abs(predicted - filmed).mean(axis=-1, keepdims=True)
    return np.repeat(1 - np.clip(factor * difference, 0, 1), 3, axis=-1)


def as_planes(pixels: np.ndarray) -> Tensor:
    """Pixels, uint8, as floats in [0, 1]."""
    return torch.from_numpy(np.ascontiguousarray(pixels)).float() / 255
