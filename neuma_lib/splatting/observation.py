"""A video from calibrated views: what the cameras saw, at which steps of a simulation, and for how long each time.

**Motion blur.** A frame shows the mean of what was there while its shutter was open. A render shows one instant, so
the renders of several steps are averaged: `exposed_steps` divides the exposure among them. The mean is taken of colours
as they are stored, over white. A camera averages light, and stores its mean by a gamma: in the middle of a blurred edge
between black and white it has 0.73 where the mean of renders has 0.5, so dark bodies look narrower by a part of the
blur. That is neglected; masks have no gamma.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from neuma_lib.errors import InputError
from neuma_lib.splatting.cameras import Cameras

_LEAST_SHARE = 0.01
"""Part of a step's time that an exposure must reach into for the step to be rendered."""
_DEVICE_SHARE = 0.3
"""Largest part of a GPU's free memory that a video may take; the rollout and the renders need the rest."""


@dataclass(frozen=True)
class Observation:
    """A video from V calibrated views that took their pictures at the same times.

    Attributes:
        frames: simulation step of each frame (0 is the start), length T, ascending: that of the middle of its exposure.
        images: straight-alpha RGBA as uint8, shape (T, V, H, W, 4), as decoded from files: a quarter of the memory of
            floats. Or, for renders of our own, floating colours over white in [0, 1], shape (T, V, H, W, 3).
            `colours` gives either as the latter.
        cameras: the V views; their precision is that of the colours.
        exposure: steps whose renders are averaged to one that shows what a frame does, relative to the frame's step,
            ascending; (0,): the picture of an instant.
        shares: weights of those renders, which sum to 1; None: equal ones.
    """

    frames: tuple[int, ...]
    images: Tensor
    cameras: Cameras
    exposure: tuple[int, ...] = (0,)
    shares: tuple[float, ...] | None = None

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
        exposure = self.exposure
        if not exposure or list(exposure) != sorted(set(exposure)):
            raise InputError(f"exposure must be steps that ascend without repeats, got {exposure}")
        if self.shares is not None and not (
            len(self.shares) == len(exposure)
            and min(self.shares) > 0
            and math.isclose(sum(self.shares), 1, rel_tol=1e-6)
        ):
            raise InputError(
                f"shares of {len(exposure)} steps must be positive and sum to 1, got {self.shares}"
            )
        if self.frames and self.frames[0] + exposure[0] < 0:
            raise InputError(
                f"the exposure {exposure} of the frame at step {self.frames[0]} begins before the start: leave the"
                " frame out, or start earlier"
            )

    def colours(self, part: slice | Sequence[int] = slice(None)) -> Tensor:
        """Colours over a white background in [0, 1] of some frames, all by default, shape (T', V, H, W, 3)."""
        images = self.stored(part)
        if images.dtype != torch.uint8:
            return images
        return over_white(images.to(self.cameras.viewmats.dtype) / 255)

    def coverage(self, part: slice | Sequence[int] = slice(None)) -> Tensor:
        """Masks in [0, 1] of some frames, all by default, shape (T', V, H, W, 1).

        Raises:
            InputError: the images are renders, which have none.
        """
        images = self.stored(part)
        if images.dtype != torch.uint8:
            raise InputError("masks can be compared with images that have an alpha channel alone")
        return images[..., 3:].to(self.cameras.viewmats.dtype) / 255

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


def several(videos: Observation | Sequence[Observation]) -> tuple[Observation, ...]:
    """One video or several of one motion, as several.

    Raises:
        InputError: there is none, or one without frames.
    """
    found = (videos,) if isinstance(videos, Observation) else tuple(videos)
    if not found or not all(video.frames for video in found):
        raise InputError("no frames to compare with: give at least one video, and each a frame")
    return found


def joint_frames(videos: Sequence[Observation]) -> tuple[int, ...]:
    """Steps of the frames of several videos of one motion, ascending."""
    return tuple(sorted({frame for video in videos for frame in video.frames}))


def rendered_steps(videos: Sequence[Observation]) -> tuple[int, ...]:
    """Steps whose states the comparison with several videos of one motion needs, ascending: frames and exposures."""
    exposed = {frame + step for video in videos for frame in video.frames for step in video.exposure}
    return tuple(sorted(exposed.union(joint_frames(videos))))


def select_frames(videos: Sequence[Observation], steps: Sequence[int]) -> tuple[Observation, ...]:
    """What several videos show at some of their steps; those that show nothing are left out."""
    wanted = set(steps)
    kept = ((video, [i for i, n in enumerate(video.frames) if n in wanted]) for video in videos)
    return tuple(video.select(indices) for video, indices in kept if indices)


def exposed_steps(length: float, most: int) -> tuple[tuple[int, ...], tuple[float, ...]]:
    """Steps to render, relative to the middle of an exposure, and the part of the exposure that each stands for.

    An odd number of steps in equal distances, as near as ``most`` allows, each for the time until half-way to the next;
    those at both ends for as much of it as the exposure reaches into.

    Args:
        length: duration of the exposure in steps.
        most: largest number of steps; 1: the middle one, so no blur.
    """
    count = most - (most + 1) % 2
    apart = max(1, math.ceil(length / count - _LEAST_SHARE))
    reach = min(count // 2, max(0, math.ceil((length / apart - 1) / 2 - _LEAST_SHARE)))
    shares = [
        max(0.0, min(1.0, length / apart / 2 - abs(k) + 0.5)) if reach else 1.0
        for k in range(-reach, reach + 1)
    ]
    total = sum(shares)
    return tuple(apart * k for k in range(-reach, reach + 1)), tuple(share / total for share in shares)


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
