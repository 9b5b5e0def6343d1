"""Videos of prediction and observation side by side, as mp4 or gif."""

import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from neuma_lib.errors import InputError
from neuma_lib.extras import require

_LABEL_HEIGHT = 18  # line of text above each panel [px]
_GIF_RATE = 50  # maximum frames per second of a GIF. Browsers replace delays below 20 ms by 100 ms.
_REPEATABLE = ("-fflags", "+bitexact", "-flags:v", "+bitexact", "-threads", "1", "-map_metadata", "-1")
"""Encoder options that make the file reproducible: no versions, no dates, one thread."""


def side_by_side(panels: Sequence[np.ndarray], labels: Sequence[str], magnify: int = 1) -> np.ndarray:
    """Place videos side by side, each below its label.

    Args:
        panels: videos (T, H, W, 3) in [0, 1] of one length and height.
        magnify: integer factor of enlargement.

    Returns:
        uint8 video (T, H', W', 3) with even sides, as video codecs require.

    Raises:
        InputError: no panels or frames, panels that differ in length or height, or labels that do not match them.
    """
    panels = [_as_bytes(panel) for panel in panels]
    if len({panel.shape[:2] for panel in panels}) != 1:
        problem = f"videos of shapes {[p.shape for p in panels]} differ in length or height"
        raise InputError("side_by_side", problem)
    if len(labels) != len(panels):
        raise InputError("side_by_side", f"{len(labels)} labels for {len(panels)} videos")
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
    """Encode frames (T, H, W, 3) of `side_by_side` as H.264. The same frames give the same bytes.

    Args:
        frame_rate: frames per second.
        quality: constant rate factor of x264. An increase by 6 halves the size of the file.

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
    """Write frames (T, H, W, 3) of `side_by_side` as a looping GIF. The same frames give the same bytes.

    All frames share one palette without dithering, which would flicker and compress badly. Delays are multiples of
    10 ms and vary where needed (30, 30 and 40 ms at 30 frames per second) to keep the duration. Frames are skipped
    above `_GIF_RATE`.
    """
    stride = math.ceil(frame_rate / _GIF_RATE)
    kept = video[::stride]
    ends = np.round(100 * stride * np.arange(1, len(kept) + 1) / frame_rate)
    palette = Image.fromarray(video[:: max(1, len(video) // 8)].reshape(-1, *video.shape[2:])).quantize(256)
    frames = [Image.fromarray(frame).quantize(palette=palette, dither=Image.Dither.NONE) for frame in kept]
    delays = (10 * np.diff(ends, prepend=0)).astype(int).tolist()
    each = {"duration": delays, "loop": 0, "optimize": False, "disposal": 1}
    frames[0].save(path, format="GIF", save_all=True, append_images=frames[1:], **each)


def _as_bytes(video: np.ndarray) -> np.ndarray:
    """A video in [0, 1] as uint8."""
    video = np.asarray(video)
    if video.ndim != 4 or video.shape[3] != 3 or len(video) == 0:
        raise InputError("video", f"shape {video.shape}, expected frames (T, H, W, 3)")
    if not np.isfinite(video).all():
        raise InputError("video", "a frame holds values that are not finite")
    return (np.clip(video, 0, 1) * 255).round().astype(np.uint8)


def _heading(label: str, width: int) -> np.ndarray:
    head = Image.new("RGB", (width, _LABEL_HEIGHT), "white")
    ImageDraw.Draw(head).text((4, 2), label, fill="black", font=ImageFont.load_default(size=12))
    return np.asarray(head)
