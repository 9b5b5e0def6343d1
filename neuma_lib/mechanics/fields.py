"""Materials that change along a body: a factor on all stresses of a law as a function of the place in the body.

E [Pa], and yield stresses and viscosities with it, are those of the factor 1. Poisson's ratio, angles and the strains
of the return map are the same everywhere. The place s at the start is measured along a direction, from 0 at the first
particle of the body to 1 at the last.
"""

from typing import ClassVar

import torch
from torch import Tensor, nn

from neuma_lib.mechanics.catalogue import FIELD
from neuma_lib.mechanics.elasticity import direction
from neuma_lib.mechanics.isotropic import Constants

WIDTH = 0.02
"""Width of the boundary of `Halves` relative to the body, which makes a motion differentiable by its place."""


class Field(Constants, nn.Module):
    """A factor on the stress. Its direction has ``elevation`` degrees above the x-z plane and ``azimuth`` degrees from
    x towards z, by default along x."""

    part = "field"
    named: "ClassVar[dict[str, type[Field]]]" = {}

    def __init_subclass__(cls, name: str, **options):
        super().__init_subclass__(**options)
        cls.constants, cls.named[name] = FIELD[name], cls

    def share(self, s: Tensor) -> Tensor:
        """Share of the second material at the places s."""
        raise NotImplementedError

    def factors(self, x: Tensor) -> Tensor:
        """Factors (N,) of the particles of a whole body at rest, x (N, 3) [m]."""
        along = x.double() @ direction(
            *(torch.tensor(self.values[key], dtype=torch.float64) for key in ("azimuth", "elevation"))
        ).to(x.device)
        low, high = along.min(), along.max()
        share = self.share((along - low) / (high - low).clamp(min=torch.finfo(x.dtype).tiny))
        return (1 + (self.values["ratio"] - 1) * share).to(x)


class Ramp(Field, name="ramp"):
    """1 + (ratio - 1) s: linear from the first end to the other, which is ``ratio`` times as stiff."""

    def share(self, s):
        return s


class Halves(Field, name="halves"):
    """1 before the ``boundary``, a share of the length, and ``ratio`` behind it."""

    def share(self, s):
        return torch.sigmoid((s - self.values["boundary"]) / WIDTH)


FIELDS = Field.named
"""Fields by name."""
