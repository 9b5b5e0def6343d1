"""A video from calibrated views: images, simulation steps and exposures.

**Motion blur.** A frame shows the mean over its exposure, a render shows one instant. Renders of several steps are
therefore averaged, with weights from `exposed_steps`. The mean is taken of stored colours over white. A camera averages
light and applies a gamma: in the middle of a blurred edge between black and white it has 0.73, the mean of renders 0.5,
so dark bodies look narrower by a fraction of the blur. This is neglected. Masks have no gamma.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from neuma_lib.errors import InputError
from neuma_lib.splatting.cameras import Cameras

_MIN_SHARE = 0.01  # minimum fraction of a step's time covered by an exposure for the step to be rendered
_DEVICE_SHARE = 0.3
"""Maximum fraction of a GPU's free memory for a video; the rollout and the renders need the rest."""


@dataclass(frozen=True)
class Observation:
    """A video from V calibrated views with simultaneous frames.

    Attributes:
        frames: simulation step of each frame (0 is the start) at the middle of its exposure, length T, ascending.
        images: straight-alpha RGBA as uint8, shape (T, V, H, W, 4), as decoded from files, which takes a quarter of the
            memory of floats. Or, for renders, floating-point colours over white in [0, 1], shape (T, V, H, W, 3).
            `colours` returns both as the latter.
        cameras: the V views; colours have their dtype.
        exposure: steps whose renders are averaged to a frame, relative to its step, ascending; (0,): no motion blur.
        shares: weights of those renders, which sum to 1; None: equal weights.
        hidden: pixels in which another body hides the observed one, which are empty, shape (T, V, H, W); None: nothing
            hides it.
    """

    frames: tuple[int, ...]
    images: Tensor
    cameras: Cameras
    exposure: tuple[int, ...] = (0,)
    shares: tuple[float, ...] | None = None
    hidden: Tensor | None = None

    def __post_init__(self):
        if len(self.frames) != len(self.images):
            problem = f"there are {len(self.images)} images for {len(self.frames)} frames"
            raise InputError("observation: images", problem)
        channels = 4 if self.images.dtype == torch.uint8 else 3
        views, height, width = len(self.cameras), self.cameras.height, self.cameras.width
        if tuple(self.images.shape[1:]) != (views, height, width, channels):
            raise InputError(
                "observation: images",
                f"have shape {tuple(self.images.shape)} and {self.images.dtype}, which do not match {views} cameras of"
                f" {width}x{height} pixels",
                "Use RGBA as uint8 or RGB as floats, shape (T, V, H, W, channels)",
            )
        if self.hidden is not None and self.hidden.shape != self.images.shape[:-1]:
            expected = f"{tuple(self.images.shape[:-1])}, as the images"
            raise InputError("observation: hidden", f"has shape {tuple(self.hidden.shape)}, not {expected}")
        if list(self.frames) != sorted(set(self.frames)):
            raise InputError("observation: frames", f"must be strictly ascending, not {self.frames}")
        exposure = self.exposure
        if not exposure or list(exposure) != sorted(set(exposure)):
            raise InputError("observation: exposure", f"must be strictly ascending steps, not {exposure}")
        if self.shares is not None and not (
            len(self.shares) == len(exposure)
            and min(self.shares) > 0
            and math.isclose(sum(self.shares), 1, rel_tol=1e-6)
        ):
            problem = f"of {len(exposure)} steps must be positive and sum to 1, not {self.shares}"
            raise InputError("observation: shares", problem)
        if self.frames and self.frames[0] + exposure[0] < 0:
            problem = f"{exposure} of the frame at step {self.frames[0]} begins before step 0"
            raise InputError("observation: exposure", problem, "Omit the frame, or start earlier")

    def colours(self, part: slice | Sequence[int] = slice(None)) -> Tensor:
        """Colours over white in [0, 1] of some frames, all by default, shape (T', V, H, W, 3)."""
        images = self.stored(part)
        if images.dtype != torch.uint8:
            return images
        return over_white(images.to(self.cameras.viewmats.dtype) / 255)

    def coverage(self, part: slice | Sequence[int] = slice(None)) -> Tensor:
        """Masks in [0, 1] of some frames, all by default, shape (T', V, H, W, 1).

        Raises:
            InputError: the images are renders without alpha.
        """
        images = self.stored(part)
        if images.dtype != torch.uint8:
            raise InputError("observation: images", "comparing masks needs an alpha channel")
        return images[..., 3:].to(self.cameras.viewmats.dtype) / 255

    def stored(self, part: slice | Sequence[int] = slice(None)) -> Tensor:
        """Images of some frames in their stored format, on the cameras' device."""
        return self.images[part].to(self.cameras.viewmats.device, non_blocking=True)

    def select(self, keep: Sequence[int]) -> "Observation":
        """The frames with the given indices."""
        keep = list(keep)
        hidden = None if self.hidden is None else self.hidden[keep]
        frames = tuple(self.frames[i] for i in keep)
        return replace(self, frames=frames, images=self.images[keep], hidden=hidden)

    def to(self, dtype: torch.dtype, device: torch.device | str | None = None) -> "Observation":
        """The same frames on another device, with another dtype of cameras and colours.

        Images are moved if they take at most `_DEVICE_SHARE` of a GPU's free memory. Otherwise `stored` moves parts.
        """
        images = self.images if self.images.dtype == torch.uint8 else self.images.to(dtype)
        if device is not None:
            images = images.to(device) if _fits(images, torch.device(device)) else images.cpu().pin_memory()
        return replace(self, images=images, cameras=self.cameras.to(dtype=dtype, device=device))


def several(videos: Observation | Sequence[Observation]) -> tuple[Observation, ...]:
    """One or several videos of one motion as a tuple. Raises InputError if there is none, or no frame."""
    result = (videos,) if isinstance(videos, Observation) else tuple(videos)
    if not result or not all(video.frames for video in result):
        raise InputError("videos", "there must be at least one video, and each must have a frame")
    return result


def joint_frames(videos: Sequence[Observation]) -> tuple[int, ...]:
    """Steps of the frames of several videos of one motion, ascending."""
    return tuple(sorted({frame for video in videos for frame in video.frames}))


def rendered_steps(videos: Sequence[Observation]) -> tuple[int, ...]:
    """Steps whose states are needed to compare with several videos of one motion (frames and exposures), ascending."""
    exposed = {frame + step for video in videos for frame in video.frames for step in video.exposure}
    return tuple(sorted(exposed.union(joint_frames(videos))))


def select_frames(videos: Sequence[Observation], steps: Sequence[int]) -> tuple[Observation, ...]:
    """The frames of several videos at some steps, without videos that have none there."""
    wanted = set(steps)
    kept = ((video, [i for i, n in enumerate(video.frames) if n in wanted]) for video in videos)
    return tuple(video.select(indices) for video, indices in kept if indices)


def exposed_steps(length: float, limit: int) -> tuple[tuple[int, ...], tuple[float, ...]]:
    """Steps to render, relative to the middle of an exposure, and their weights.

    An odd number of equidistant steps, as dense as ``limit`` allows. A step represents the time until half-way to its
    neighbours, the first and last one as much of it as the exposure covers.

    Args:
        length: duration of the exposure in steps.
        limit: maximum number of steps; 1: the middle one, without motion blur.
    """
    count = limit - (limit + 1) % 2
    stride = max(1, math.ceil(length / count - _MIN_SHARE))
    reach = min(count // 2, max(0, math.ceil((length / stride - 1) / 2 - _MIN_SHARE)))
    shares = [
        max(0.0, min(1.0, length / stride / 2 - abs(k) + 0.5)) if reach else 1.0
        for k in range(-reach, reach + 1)
    ]
    total = sum(shares)
    return tuple(stride * k for k in range(-reach, reach + 1)), tuple(share / total for share in shares)


def _fits(images: Tensor, device: torch.device) -> bool:
    """Whether images fit into the memory of a device."""
    if device.type != "cuda":
        return True
    free, _ = torch.cuda.mem_get_info(device)
    return images.numel() * images.element_size() <= _DEVICE_SHARE * free


def over_white(rgba: Tensor) -> Tensor:
    """Composite straight-alpha RGBA (..., 4) in [0, 1] over white: colour (..., 3)."""
    alpha = rgba[..., 3:]
    return rgba[..., :3] * alpha + (1 - alpha)
