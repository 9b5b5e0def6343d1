"""How far out Gaussians are seen, which is farther than their centres."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from neuma_lib.splatting.viewpoints import sphere_directions

SEEN = 0.05
"""Where less than this share of the light behind it is taken away, a Gaussian is over."""
DIRECTIONS = 100
"""Of planes that touch them, beside the axes: nothing of an ellipsoid is farther beyond their hull than some percent of
its largest half-axis."""


def outermost(means: Tensor, covars: Tensor, opacities: Tensor) -> Tensor:
    """Points (K, 3) [m] whose hull holds what is seen of Gaussians, almost.

    A Gaussian of opacity o is seen up to the ellipsoid on which o exp(-r^2 / 2) = `SEEN`. Each point is where a plane,
    one of `DIRECTIONS` normals all around and the six axes, touches the outermost ellipsoid.

    Args:
        means: (G, 3) [m].
        covars: (G, 3, 3) [m^2].
        opacities: (G,) in [0, 1]; fainter ones than `SEEN` are left out, and there may be none.
    """
    shown = opacities > SEEN
    means, covars = means[shown].double(), covars[shown].double()
    if not len(means):
        return means
    reach = (2 * (opacities[shown].double() / SEEN).log()).sqrt()
    axes = np.concatenate([np.eye(3), -np.eye(3), sphere_directions(DIRECTIONS)])
    found = []
    for normal in torch.from_numpy(axes).to(means):
        along = covars @ normal
        wide = (along @ normal).clamp_min(torch.finfo(along.dtype).tiny).sqrt()
        first = (means @ normal + reach * wide).argmax()
        found.append(means[first] + reach[first] / wide[first] * along[first])
    return torch.stack(found)
