"""Mattes of photographs of any size, each cropped to its mask and downsampled if larger than needed."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from neuma_lib.config.photographs import PhotographsConfig
from neuma_lib.errors import InputError
from neuma_lib.geometry.visual_hull import lacking
from neuma_lib.io.images import (
    OPENGL_TO_OPENCV,
    image_file,
    intrinsic_matrix,
    load_views,
    read_hidden,
    read_rgba,
    read_transforms,
)
from neuma_lib.splatting.cameras import Cameras

MIN_PHOTOGRAPHS = 4  # minimum number of photographs of a body
MAX_LEFT_OUT = 0.3  # maximum fraction of rejected photographs
_MIN_MARGIN = 8  # minimum margin around a mask [px], larger than the radius of the window of SSIM


@dataclass(frozen=True, eq=False)
class StaticViews:
    """Views of an object at rest.

    Attributes:
        images: V of RGBA with straight alpha in [0, 1], (H, W, 4) each; a tensor if all have one size.
        cameras: V cameras; V sets of one if sizes may differ.
        photographs: settings of photographs; None for rendered images, which are exact and have one exposure.
        floor: height y of the floor under the object [m]; None: no floor, or cameras see the underside.
        hidden: pixels of each view that show another body, (H, W) each; None for images of a body without others.
        left_out: files of rejected photographs, whose masks lack a part of the body.
    """

    images: torch.Tensor | list[torch.Tensor]
    cameras: Cameras | list[Cameras]
    photographs: PhotographsConfig | None = None
    floor: float | None = None
    left_out: tuple[str, ...] = ()
    hidden: Sequence[torch.Tensor] | None = None

    def to(self, device: torch.device) -> "StaticViews":
        """The same views on another device."""
        images, cameras = self.images, self.cameras
        if isinstance(images, torch.Tensor):
            return replace(self, images=images.to(device), cameras=cameras.to(device=device))
        return replace(
            self, images=[i.to(device) for i in images], cameras=[c.to(device=device) for c in cameras]
        )


def load_static(transforms: str | Path, settings: PhotographsConfig) -> StaticViews:
    """Views of an object at rest, cropped and checked if the list has the entry `photographs`.

    Raises:
        InputError: see `neuma_lib.io.images.read_image_set`; fewer than `MIN_PHOTOGRAPHS` photographs, or more than
            `MAX_LEFT_OUT` of them with masks that lack a part of the body.
    """
    data, labels = read_transforms(transforms), read_hidden(transforms)
    hidden = None if labels is None else [*torch.from_numpy(labels)]
    if "photographs" not in data:
        return StaticViews(*load_views(transforms), hidden=hidden)
    names = [frame["file_path"] for frame in data["frames"]]
    if len(names) < MIN_PHOTOGRAPHS:
        problem = f"has {len(names)} mattes of photographs, at least {MIN_PHOTOGRAPHS} are needed"
        raise InputError(transforms, problem, "Take 30 to 60 photographs from all sides")
    views = [
        _cut_out(Path(transforms), {**data, **frame}, settings, labels[i] if hidden else None)
        for i, frame in enumerate(data["frames"])
    ]
    floor = data["photographs"]["floor"]
    kept = list(range(len(names)))
    if settings.lacking < 1:
        masks = [
            image[..., 3] if other is None else image[..., 3].maximum(other) for image, _, other in views
        ]
        shares = lacking(masks, [camera for _, camera, _ in views], settings.agreement, floor)
        kept = (shares <= settings.lacking).nonzero()[:, 0].tolist()
    left_out = tuple(name for i, name in enumerate(names) if i not in kept)
    if len(left_out) > MAX_LEFT_OUT * len(names):
        raise InputError(
            transforms,
            f"{len(left_out)} of {len(names)} masks lack more than {100 * settings.lacking:.0f} % of the body that the"
            f" others show: {', '.join(left_out[:5])}",
            "Provide your own masks for them, photograph the whole object in front of another colour, or set"
            " photographs.lacking",
        )
    images, cameras, others = map(list, zip(*(views[i] for i in kept)))
    hidden = [other > 0.5 for other in others] if hidden else None
    return StaticViews(images, cameras, settings, floor, left_out, hidden)


def _cut_out(
    listed_in: Path, frame: Mapping[str, Any], settings: PhotographsConfig, hidden: np.ndarray | None
) -> tuple[torch.Tensor, Cameras, torch.Tensor | None]:
    """A matte (h, w, 4) cropped to its mask, the pixels that others hide and a margin; its camera; and these pixels."""
    file = image_file(listed_in.parent, frame["file_path"], listed_in)
    size = (frame["w"], frame["h"]) if "w" in frame and "h" in frame else None
    pixels = read_rgba(file, frame.get("sha256"), size)
    height, width = pixels.shape[:2]
    K = intrinsic_matrix(frame, width, height)
    known = pixels[..., 3] > 127
    if hidden is not None:
        known = known | hidden
        pixels = np.dstack([pixels, 255 * hidden.astype(np.uint8)])
    rows, columns = (np.flatnonzero(known.any(axis=axis)) for axis in (1, 0))
    margin = max(_MIN_MARGIN, round(settings.margin * max(np.ptp(rows), np.ptp(columns))))
    left, top = max(0, columns[0] - margin), max(0, rows[0] - margin)
    right, bottom = min(width, columns[-1] + 1 + margin), min(height, rows[-1] + 1 + margin)
    window = pixels[top:bottom, left:right].astype(np.float32) / 255
    K[:2, 2] -= (left, top)
    shrink = settings.longest / max(window.shape[:2])
    if shrink < 1:
        window, factors = _reduced(window, shrink)
        K[:2] *= factors[:, None]
    viewmat = np.linalg.inv(np.array(frame["transform_matrix"], np.float64) @ OPENGL_TO_OPENCV)
    pose, intrinsics = (torch.from_numpy(matrix).float()[None] for matrix in (viewmat, K))
    camera = Cameras(pose, intrinsics, window.shape[1], window.shape[0])
    image, *other = torch.from_numpy(window).split([4, window.shape[2] - 4], dim=-1)
    return image, camera, None if hidden is None else other[0][..., 0]


def _reduced(rgba: np.ndarray, factor: float) -> tuple[np.ndarray, np.ndarray]:
    """A matte, and more channels, downsampled by area means, and the scale factors in x and y."""
    height, width = rgba.shape[:2]
    rows, columns = max(1, round(factor * height)), max(1, round(factor * width))
    # colours are weighted by alpha, because those of transparent pixels are arbitrary
    weighted = np.concatenate([rgba[..., :3] * rgba[..., 3:4], rgba[..., 3:]], axis=-1)
    small = _area_means(_area_means(weighted, rows).swapaxes(0, 1), columns).swapaxes(0, 1)
    small[..., :3] /= np.maximum(small[..., 3:4], 1e-6)
    return np.clip(small, 0, 1).astype(np.float32), np.array([columns / width, rows / height])


def _area_means(pixels: np.ndarray, count: int) -> np.ndarray:
    """Means over equal intervals of the first axis, whose ends may lie inside a pixel."""
    total = np.concatenate([np.zeros((1, *pixels.shape[1:])), np.cumsum(pixels, axis=0, dtype=np.float64)])
    ends = np.linspace(0, len(pixels), count + 1)
    before = np.minimum(ends.astype(int), len(pixels) - 1)
    part = (ends - before)[:, None, None]
    return np.diff((1 - part) * total[before] + part * total[before + 1], axis=0) * (count / len(pixels))
