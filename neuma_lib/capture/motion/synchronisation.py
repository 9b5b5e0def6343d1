"""Frames of a take in simulation time: convert the mattes of each camera to frames for training."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from PIL import Image

from neuma_lib.capture.masks.mattes import numbered
from neuma_lib.capture.motion.timing import row_times
from neuma_lib.errors import InputError

_MIN_FRAMES = 8  # frames after the start required of each camera: fewer show no contact


def frame_times(
    frames: Sequence[Mapping[str, Any]], mattes: np.ndarray, row_time: float, sensor_rows: int
) -> np.ndarray:
    """Exposure times of the object in each frame, on the camera's clock, (T,) [s].

    Args:
        frames: entries with ``time`` [s] and ``h`` [px].
        mattes: RGBA pictures of the object, (T, H, W, 4).
        row_time: of a rolling shutter [s].
        sensor_rows: rows of the recorded frames.
    """
    rows = np.array([np.flatnonzero(matte[..., 3].any(axis=1)).mean() + 0.5 for matte in mattes])
    times = np.array([frame["time"] for frame in frames])
    return row_times(times, rows, row_time, frames[0]["h"], sensor_rows)


def chosen_frames(times: np.ndarray, duration: float, most: int, name: str) -> np.ndarray:
    """Indices of at most ``most`` frames, evenly spread over the time from 0 to ``duration`` [s].

    Args:
        times: since the start, ascending, (T,) [s].
        name: of take and camera for messages.

    Raises:
        InputError: fewer than `_MIN_FRAMES` lie in this interval.
    """
    inside = np.flatnonzero((times >= 0) & (times <= duration))
    if len(inside) < _MIN_FRAMES:
        raise InputError(
            name,
            f"{len(inside)} frames show the object in the first {duration:g} s of flight, {_MIN_FRAMES} are required",
            "Film until the object rests, increase `duration` in capture.yaml, and check the masks' contact sheet",
        )
    places = np.linspace(0, len(inside) - 1, min(most, len(inside)))
    return inside[np.round(places).astype(int)]


def reduced(rgba: np.ndarray, width: int) -> np.ndarray:
    """Straight-alpha RGBA (H, W, 4), uint8, averaged to a longer side of ``width`` pixels, never enlarged.

    Colours are weighted by coverage, so the background does not contribute.
    """
    height, across = rgba.shape[:2]
    factor = width / max(height, across)
    if factor >= 1:
        return rgba
    size = (max(1, round(across * factor)), max(1, round(height * factor)))
    plain = rgba.astype(np.float32)
    plain[..., :3] *= plain[..., 3:] / 255
    planes = (Image.fromarray(plain[..., k]).resize(size, Image.Resampling.BOX) for k in range(4))
    small = np.stack([np.asarray(plane, np.float32) for plane in planes], axis=-1)
    small[..., :3] *= 255 / np.maximum(small[..., 3:], 1e-6)
    small = np.clip(np.rint(small), 0, 255).astype(np.uint8)
    small[small[..., 3] == 0] = 0
    return small


def reduced_labels(labels: np.ndarray, size: tuple[int, int], count: int) -> np.ndarray:
    """Numbers of bodies (H, W), from 1, in a picture of another width and height, see `numbered`."""
    shares = (Image.fromarray(255 * (labels == k).astype(np.uint8)) for k in range(1, count + 1))
    return numbered(np.stack([np.asarray(share.resize(size, Image.Resampling.BOX)) for share in shares]))


def reduced_intrinsics(frame: Mapping[str, Any], size: tuple[int, int]) -> dict[str, float]:
    """Intrinsics of an entry, scaled to a picture of another width and height [px]."""
    factors = {"x": size[0] / frame["w"], "y": size[1] / frame["h"]}
    scaled = {key: frame[key] * factors[key[-1]] for key in ("fl_x", "fl_y", "cx", "cy")}
    return {**scaled, "w": size[0], "h": size[1]}


def without_gain(rgba: np.ndarray, gain: Sequence[float]) -> np.ndarray:
    """RGBA, uint8, with colours divided by the camera's gain relative to the photographs, (3,)."""
    pixels = rgba.copy()
    pixels[..., :3] = np.clip(np.rint(rgba[..., :3] / np.asarray(gain, np.float32)), 0, 255).astype(np.uint8)
    return pixels
