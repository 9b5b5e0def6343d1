"""Moving pictures: prediction beside observation as mp4, and strips of frames as one still."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import imageio.v2 as imageio
import numpy as np
from PIL import Image, ImageDraw, ImageFont

from neuma_lib.errors import InputError

_LABEL = 18  # height of the line of text above each panel [px]


def side_by_side(panels: Sequence[np.ndarray], labels: Sequence[str], magnify: int = 1) -> np.ndarray:
    """Put videos next to each other under their labels.

    Args:
        panels: videos (T, H, W, 3) in [0, 1] of one length and height.
        labels: one a video.
        magnify: whole factor of enlargement.

    Returns:
        uint8 video (T, H', W', 3) with even sides, as video codecs want them.
    """
    if len({p.shape[:2] for p in map(np.asarray, panels)}) != 1:
        raise InputError(f"side_by_side: videos differ in length or height: {[np.shape(p) for p in panels]}")
    columns = []
    for panel, label in zip(panels, labels, strict=True):
        pixels = (np.clip(np.asarray(panel), 0, 1) * 255).round().astype(np.uint8)
        pixels = pixels.repeat(magnify, axis=1).repeat(magnify, axis=2)
        head = Image.new("RGB", (pixels.shape[2], _LABEL), "white")
        ImageDraw.Draw(head).text((4, 2), label, fill="black", font=ImageFont.load_default(size=12))
        columns.append(np.concatenate([np.broadcast_to(np.asarray(head), (len(pixels), _LABEL, *pixels.shape[2:])), pixels], 1))
    video = np.concatenate(columns, axis=2)
    even = [(0, n % 2) for n in video.shape[1:3]]
    return np.pad(video, [(0, 0), *even, (0, 0)], mode="edge")


def write_mp4(path: str | Path, video: np.ndarray, frame_rate: float) -> None:
    """Encode a uint8 video (T, H, W, 3) as H.264; the same frames give the same bytes."""
    with imageio.get_writer(
        path,
        format="FFMPEG",
        mode="I",
        fps=frame_rate,
        codec="libx264",
        macro_block_size=2,
        output_params=["-crf", "18", "-preset", "medium", "-fflags", "+bitexact", "-flags:v", "+bitexact", "-threads", "1"],
    ) as writer:
        for frame in video:
            writer.append_data(frame)


def strip(video: np.ndarray, count: int = 6) -> np.ndarray:
    """Evenly spaced frames of a video (T, H, W, 3) side by side, (H, count * W, 3)."""
    index = np.linspace(0, len(video) - 1, min(count, len(video))).round().astype(int)
    return np.concatenate([video[i] for i in index], axis=1)
