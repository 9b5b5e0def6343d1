"""What the cameras of an observation would have seen of a simulated body, frame by frame, exposure included."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import torch
from torch import Tensor

from neuma_lib.config.base import Compared
from neuma_lib.coupling.particle_gs import ParticleGS
from neuma_lib.splatting.image_loss import mean_squared_error
from neuma_lib.splatting.observation import Observation


class Filmed:
    """Renders that stand beside the frames of an observation.

    Args:
        renderer: `ParticleGS` of the body for the observation's cameras, or what renders as it does.
        observation: whose frames and exposure count.
        steps: those whose states are given, ascending; a frame's exposure must be among them.
        compared: what is rendered, colours over white or how far the body covers a pixel.

    Attributes:
        renderer: as given.
        batch: frames to render together.
        error_batch: frames to take the `error` of together.
    """

    def __init__(
        self, renderer, observation: Observation, steps: Sequence[int], compared: Compared = "colour"
    ):
        self.renderer = renderer
        self._picture: Callable[..., Tensor] = renderer if compared == "colour" else renderer.coverage
        offsets, shares = observation.exposure, observation.shares
        self._sharp = len(offsets) == 1 and compared == "colour" and isinstance(renderer, ParticleGS)
        self.batch = max(1, renderer.frames_per_batch // len(offsets))
        self.error_batch = renderer.frames_per_error if self._sharp else self.batch
        place = {step: k for k, step in enumerate(steps)}
        rows = [[place[frame + offset] for offset in offsets] for frame in observation.frames]
        self._shares = torch.tensor(shares or [1 / len(offsets)] * len(offsets), dtype=torch.float64)
        # The usual case, every state for one frame, is spared a copy of the states.
        self._rows = None
        if rows != [[k] for k in range(len(steps))]:
            self._rows = torch.tensor(rows) if len(offsets) > 1 else torch.tensor(rows)[:, 0]

    def states(self, values: Tensor, part: slice = slice(None)) -> Tensor:
        """Of states (S, ...) at the steps, those of some frames: (T, ...), or (T, K, ...) if K steps are exposed."""
        return values[part] if self._rows is None else values[self._rows[part].to(values.device)]

    def __call__(self, x: Tensor, F: Tensor) -> Tensor:
        """Images (T, V, H, W, C) of the `states` x (T, N, 3) [m] and F (T, N, 3, 3) of some frames.

        C is 3 for colours in [0, 1], 1 for coverage. Those of K steps, x (T, K, N, 3), are averaged.
        """
        if x.ndim == 3:
            return self._picture(x, F)
        instants = self._picture(x.flatten(0, 1), F.flatten(0, 1)).unflatten(0, x.shape[:2])
        return (instants * self._shares.to(instants).view(-1, *[1] * (instants.ndim - 2))).sum(1)

    def error(self, x: Tensor, F: Tensor, seen: Tensor) -> Tensor:
        """Mean squared difference (T,) of each frame's images from ``seen``, those that stand for them in the video.

        Differentiable with respect to the states, which are as above.

        Args:
            seen: as of `mean_squared_error`, in as many channels as are compared.
        """
        if self._sharp:
            return self.renderer.error(x, F, seen)
        return mean_squared_error(self(x, F), seen)
