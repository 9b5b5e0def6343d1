"""Renders of a simulated body for the cameras and frames of an observation, with motion blur."""

from collections.abc import Callable, Sequence

import torch
from torch import Tensor

from neuma_lib.config.base import Compared
from neuma_lib.coupling.particle_gs import ParticleGS
from neuma_lib.splatting.image_loss import mean_squared_error
from neuma_lib.splatting.observation import Observation


class Filmed:
    """Renders of the frames of an observation.

    Args:
        renderer: `ParticleGS` of the body for the observation's cameras, or an equivalent.
        observation: defines frames and exposure.
        steps: steps of the given states, ascending; must include those of all exposures.
        compared: rendered quantity, colours over white or coverage.

    Attributes:
        renderer: as given.
        batch: number of frames to render together.
        error_batch: number of frames to compute the `error` of together.
    """

    def __init__(
        self, renderer, observation: Observation, steps: Sequence[int], compared: Compared = "colour"
    ):
        self.renderer = renderer
        self._picture: Callable[..., Tensor] = renderer if compared == "colour" else renderer.coverage
        offsets, shares = observation.exposure, observation.shares
        self._hidden, self._blank = observation.hidden, 1.0 if compared == "colour" else 0.0
        whole = len(offsets) == 1 and self._hidden is None
        self._sharp = whole and compared == "colour" and isinstance(renderer, ParticleGS)
        self.batch = max(1, renderer.frames_per_batch // len(offsets))
        self.error_batch = renderer.frames_per_error if self._sharp else self.batch
        index = {step: k for k, step in enumerate(steps)}
        rows = [[index[frame + offset] for offset in offsets] for frame in observation.frames]
        self._shares = torch.tensor(shares or [1 / len(offsets)] * len(offsets), dtype=torch.float64)
        # None avoids a copy of the states in the usual case of one state per frame
        self._rows = None
        if rows != [[k] for k in range(len(steps))]:
            self._rows = torch.tensor(rows) if len(offsets) > 1 else torch.tensor(rows)[:, 0]

    def states(self, values: Tensor, part: slice = slice(None)) -> Tensor:
        """Select the states of some frames, (T, ...) or (T, K, ...) for K exposed steps, from those at all steps."""
        return values[part] if self._rows is None else values[self._rows[part].to(values.device)]

    def __call__(self, x: Tensor, F: Tensor, part: slice = slice(None)) -> Tensor:
        """Images (T, V, H, W, C) of the `states` x (T, N, 3) [m] and F (T, N, 3, 3) of some frames.

        C is 3 for colours in [0, 1], 1 for coverage. Images of K exposed steps, x (T, K, N, 3), are averaged. Pixels in
        which another body hides this one are empty, as in the observation.

        Args:
            part: the frames, for an observation with hidden pixels.
        """
        images = self._averaged(x, F)
        if self._hidden is None:
            return images
        return images.masked_fill(self._hidden[part].to(images.device)[..., None], self._blank)

    def _averaged(self, x: Tensor, F: Tensor) -> Tensor:
        if x.ndim == 3:
            return self._picture(x, F)
        instants = self._picture(x.flatten(0, 1), F.flatten(0, 1)).unflatten(0, x.shape[:2])
        return (instants * self._shares.to(instants).view(-1, *[1] * (instants.ndim - 2))).sum(1)

    def error(self, x: Tensor, F: Tensor, seen: Tensor, part: slice = slice(None)) -> Tensor:
        """Mean squared difference (T,) of each frame's images from the video ``seen`` (see `mean_squared_error`).

        Differentiable with respect to the states.
        """
        if self._sharp:
            return self.renderer.error(x, F, seen)
        return mean_squared_error(self(x, F, part), seen)
