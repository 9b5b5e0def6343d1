"""Moving pictures: prediction beside observation as mp4 or gif."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from neuma_lib.errors import InputError
from neuma_lib.extras import require

_LABEL_HEIGHT = 18
"""Line of text above each panel [px]."""
_GIF_RATE = 50
"""Frames a second that browsers show: shorter delays than 20 ms they take for 100."""
_REPEATABLE = ("-fflags", "+bitexact", "-flags:v", "+bitexact", "-threads", "1", "-map_metadata", "-1")
"""Encoder options that keep versions and dates out of the file, and threads from changing it."""


def side_by_side(panels: Sequence[np.ndarray], labels: Sequence[str], magnify: int = 1) -> np.ndarray:
    """Put videos next to each other under their labels.

    Args:
        panels: videos (T, H, W, 3) in [0, 1] of one length and height.
        labels: one a video.
        magnify: whole factor of enlargement.

    Returns:
        uint8 video (T, H', W', 3) with even sides, as video codecs want them.

    Raises:
        InputError: no panels or frames, panels that differ in length or height, or labels that do not match them.
    """
    panels = [_as_bytes(panel) for panel in panels]
    if len({panel.shape[:2] for panel in panels}) != 1:
        raise InputError(f"side_by_side: videos differ in length or height: {[p.shape for p in panels]}")
    if len(labels) != len(panels):
        raise InputError(f"side_by_side: {len(labels)} labels for {len(panels)} videos")
    columns = []
    for panel, label in zip(panels, labels, strict=True):
        pixels = panel.repeat(magnify, axis=1).repeat(magnify, axis=2)
        head = np.broadcast_to(
            _heading(label, pixels.shape[2]), (len(pixels), _LABEL_HEIGHT, *pixels.shape[2:])
        )
        columns.append(np.concatenate([head, pixels], axis=1))
    video = np.concatenate(columns, axis=2)
    height, width = video.shape[1:3]
    return np.pad(video, [(0, 0), (0, height % 2), (0, width % 2), (0, 0)], mode="edge")


def write_mp4(path: str | Path, video: np.ndarray, frame_rate: float, quality: int = 18) -> None:
    """Encode frames (T, H, W, 3) of `side_by_side` as H.264; the same frames give the same bytes.

    Args:
        frame_rate: frames a second.
        quality: constant rate factor of x264; 6 more halve the size of the file.

    Raises:
        InputError: imageio is not installed.
    """
    imageio = require("imageio.v2", "workflow")
    rate = ["-crf", str(quality), "-preset", "medium"]
    options = {"fps": frame_rate, "codec": "libx264", "output_params": [*rate, *_REPEATABLE]}
    with imageio.get_writer(path, format="FFMPEG", mode="I", macro_block_size=2, **options) as writer:
        for frame in video:
            writer.append_data(frame)


def write_gif(path: str | Path, video: np.ndarray, frame_rate: float) -> None:
    """Write frames (T, H, W, 3) of `side_by_side` as a GIF that repeats for ever; the same frames give the same bytes.

    All frames share one palette, without dithering, which would flicker and compress badly. Delays are whole hundredths
    of a second, of several lengths where the rate has none (30, 30 and 40 ms at 30 frames a second), so that the film
    lasts as long as it should. Above `_GIF_RATE` every second frame is left out, or more.
    """
    stride = math.ceil(frame_rate / _GIF_RATE)
    shown = video[::stride]
    ends = np.round(100 * stride * np.arange(1, len(shown) + 1) / frame_rate)
    palette = Image.fromarray(video[:: max(1, len(video) // 8)].reshape(-1, *video.shape[2:])).quantize(256)
    frames = [Image.fromarray(frame).quantize(palette=palette, dither=Image.Dither.NONE) for frame in shown]
    delays = (10 * np.diff(ends, prepend=0)).astype(int).tolist()
    each = {"duration": delays, "loop": 0, "optimize": False, "disposal": 1}
    frames[0].save(path, format="GIF", save_all=True, append_images=frames[1:], **each)


def _as_bytes(video: np.ndarray) -> np.ndarray:
    """A video in [0, 1] as uint8."""
    video = np.asarray(video)
    if video.ndim != 4 or video.shape[3] != 3 or len(video) == 0:
        raise InputError(f"video: shape {video.shape}; expected frames (T, H, W, 3)")
    if not np.isfinite(video).all():
        raise InputError("video: a frame holds values that are not finite")
    return (np.clip(video, 0, 1) * 255).round().astype(np.uint8)


def _heading(label: str, width: int) -> np.ndarray:
    head = Image.new("RGB", (width, _LABEL_HEIGHT), "white")
    ImageDraw.Draw(head).text((4, 2), label, fill="black", font=ImageFont.load_default(size=12))
    return np.asarray(head)
