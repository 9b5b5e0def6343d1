"""Image measures between a prediction and a real video, for the object and for the whole picture.

Measures of **the object** compare colours over white on the bounding box of predicted and true object
(`neuma_lib.evaluation.image_metrics`). Measures of **the whole picture** compare the undistorted frame with the
prediction composited over the empty scene. The common background makes their PSNR and SSIM high for any prediction, so
they only rank methods on one video. Shadows and reflections of the object are missing in the prediction.
"""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor

from neuma_lib.capture.masks.regions import iou
from neuma_lib.errors import InputError
from neuma_lib.evaluation.image_metrics import MEASURES, image_metrics, psnr, ssim
from neuma_lib.evaluation.lpips import LPIPS
from neuma_lib.evaluation.text_tables import as_csv

SCENE = "scene_"  # prefix of measures of the whole picture
WHOLE = ("psnr", "ssim", "lpips_alex")
"""Measures of the whole picture, without VGG, which takes a second per frame on one core."""
COLUMNS = (*MEASURES, "iou", *(f"{SCENE}{name}" for name in WHOLE))
"""Names of the measures of a frame. ``iou`` is that of predicted and true mask."""
DIGITS = {"psnr": 2, "ssim": 4, "lpips_vgg": 4, "lpips_alex": 4, "iou": 4}
OPAQUE = 0.5  # opacity above which a pixel belongs to a mask


def composited(colours: Tensor, alpha: Tensor, background: Tensor | float) -> Tensor:
    """Composite premultiplied colours (..., 3) with opacity (...) over a background (..., 3)."""
    return colours + (1 - alpha[..., None]) * background


def exposed(background: np.ndarray, gain: Sequence[float], offset: Sequence[float]) -> np.ndarray:
    """The empty scene (H, W, 3), uint8, times gain plus offset (3,) [0 to 255], clipped and converted to [0, 1]."""
    return np.clip(background * np.asarray(gain, np.float32) + np.asarray(offset, np.float32), 0, 255) / 255


def captured_metrics(
    colours: Tensor,
    alpha: Tensor,
    matte: Tensor,
    picture: Tensor,
    empty: Tensor,
    networks: Mapping[str, LPIPS],
    margin: float,
) -> dict[str, float]:
    """Measures of one frame, those of `COLUMNS` for which there are networks.

    Args:
        colours: prediction over black, in [0, 1], (H, W, 3).
        alpha: its opacity, (H, W).
        matte: the true object, straight-alpha RGBA in [0, 1], (H, W, 4).
        picture: the true frame, in [0, 1], (H, W, 3).
        empty: the empty scene at the frame's exposure, in [0, 1], (H, W, 3).
        networks, margin: see `image_metrics`.

    Raises:
        InputError: shapes differ, or the object is in neither picture.
    """
    if not (colours.shape == picture.shape == empty.shape == matte[..., :3].shape):
        shapes = [tuple(each.shape) for each in (colours, picture, empty, matte)]
        problem = f"prediction, frame, empty scene and matte differ in size: {shapes}"
        raise InputError("image measures", problem)
    mask = matte[..., 3]
    true = composited(matte[..., :3] * mask[..., None], mask, 1.0)
    metrics = image_metrics(composited(colours, alpha, 1.0), alpha, true, mask, networks, margin)
    pair = [each.clamp(0, 1) for each in (composited(colours, alpha, empty), picture)]
    arrays = [each.cpu().numpy() for each in pair]
    planes = [each.permute(2, 0, 1)[None] for each in pair]
    metrics["iou"] = iou(*((each > OPAQUE).cpu().numpy() for each in (alpha, mask)))
    metrics |= {f"{SCENE}psnr": psnr(*arrays), f"{SCENE}ssim": ssim(*arrays)}
    networks = {name: network for name, network in networks.items() if f"lpips_{name}" in WHOLE}
    return metrics | {f"{SCENE}lpips_{name}": float(network(*planes)) for name, network in networks.items()}


def averaged(frames: Sequence[Mapping[str, float]]) -> dict[str, float]:
    """Mean of each measure over frames. Raises InputError if there are none."""
    if not frames:
        raise InputError("image measures", "there are no frames to average")
    return {name: float(np.mean([frame[name] for frame in frames])) for name in frames[0]}


def image_rows(entries: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """Rows of the table: each camera of each take, then all training frames, and all held-out frames.

    Args:
        entries: for each method, take and camera ``method``, ``title``, ``throw`` (the take), ``camera``, ``learned``
            (whether these are training frames) and ``frames``, a list of measures.

    Returns:
        The same keys, with ``frames`` the number of frames, and the mean measures. Take and camera are "all" in rows of
        all frames.
    """
    rows = [_row(entry, entry["frames"]) for entry in entries]
    for method in dict.fromkeys(entry["method"] for entry in entries):
        for learned in (True, False):
            part = [entry for entry in entries if (entry["method"], entry["learned"]) == (method, learned)]
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


def error_picture(predicted: np.ndarray, true: np.ndarray, factor: float = 3.0) -> np.ndarray:
    """Absolute difference of two pictures (..., 3) in [0, 1], from white (none) to black."""
    difference = np.abs(predicted - true).mean(axis=-1, keepdims=True)
    return np.repeat(1 - np.clip(factor * difference, 0, 1), 3, axis=-1)


def as_planes(pixels: np.ndarray) -> Tensor:
    """Convert uint8 pixels to floats in [0, 1]."""
    return torch.from_numpy(np.ascontiguousarray(pixels)).float() / 255
