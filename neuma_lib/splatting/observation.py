"""A video from calibrated views: what the cameras saw."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from neuma_lib.errors import InputError
from neuma_lib.splatting.cameras import Cameras

_DEVICE_SHARE = 0.3
"""Largest part of a GPU's free memory that a video may take; the rollout and the renders need the rest."""


@dataclass(frozen=True)
class Observation:
    """A video from V calibrated views.

    Attributes:
        frames: simulation step of each frame (0 is the start), length T, ascending.
        images: straight-alpha RGBA as uint8, shape (T, V, H, W, 4), as decoded from files: a quarter of the memory of
            floats. Or, for renders of our own, floating colours over white in [0, 1], shape (T, V, H, W, 3).
            `colours` gives either as the latter.
        cameras: the V views; their precision is that of the colours.
    """

    frames: tuple[int, ...]
    images: Tensor
    cameras: Cameras

    def __post_init__(self):
        if len(self.frames) != len(self.images):
            raise InputError(
                f"{len(self.images)} images for {len(self.frames)} frames: every frame needs an image"
            )
        channels = 4 if self.images.dtype == torch.uint8 else 3
        views, height, width = len(self.cameras), self.cameras.height, self.cameras.width
        if tuple(self.images.shape[1:]) != (views, height, width, channels):
            raise InputError(
                f"images of shape {tuple(self.images.shape)} and {self.images.dtype} do not fit {views} cameras of"
                f" {width}x{height} pixels: give RGBA as uint8 or RGB as floats, (T, V, H, W, channels)"
            )
        if list(self.frames) != sorted(set(self.frames)):
            raise InputError(f"frames must ascend without repeats, got {self.frames}")

    @property
    def steps(self) -> int:
        """Simulation steps from the start to the last frame."""
        return self.frames[-1]

    def colours(self, part: slice | Sequence[int] = slice(None)) -> Tensor:
        """Colours over a white background in [0, 1] of some frames, all by default, shape (T', V, H, W, 3)."""
        images = self.stored(part)
        if images.dtype != torch.uint8:
            return images
        return over_white(images.to(self.cameras.viewmats.dtype) / 255)

    def stored(self, part: slice | Sequence[int] = slice(None)) -> Tensor:
        """Images of some frames as they are stored, on the cameras' device."""
        return self.images[part].to(self.cameras.viewmats.device, non_blocking=True)

    def select(self, keep: Sequence[int]) -> Observation:
        """The frames with the given indices."""
        keep = list(keep)
        return replace(self, frames=tuple(self.frames[i] for i in keep), images=self.images[keep])

    def to(self, dtype: torch.dtype, device: torch.device | str | None = None) -> Observation:
        """The same frames on another device, with cameras and colours in another precision.

        Images go along if they take at most `_DEVICE_SHARE` of a GPU's free memory. Otherwise they stay, and go there
        a part at a time (`stored`).
        """
        images = self.images if self.images.dtype == torch.uint8 else self.images.to(dtype)
        if device is not None:
            images = images.to(device) if _fits(images, torch.device(device)) else images.cpu().pin_memory()
        return replace(self, images=images, cameras=self.cameras.to(dtype=dtype, device=device))


def _fits(images: Tensor, device: torch.device) -> bool:
    """Whether images should be kept on a device."""
    if device.type != "cuda":
        return True
    free, _ = torch.cuda.mem_get_info(device)
    return images.numel() * images.element_size() <= _DEVICE_SHARE * free


def over_white(rgba: Tensor) -> Tensor:
    """Composite straight-alpha RGBA (..., 4) in [0, 1] over white: colour (..., 3)."""
    alpha = rgba[..., 3:]
    return rgba[..., :3] * alpha + (1 - alpha)
