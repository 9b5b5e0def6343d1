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
    axes = torch.from_numpy(np.concatenate([np.eye(3), -np.eye(3), sphere_directions(DIRECTIONS)])).to(means)
    # first those alone whose surrounding ball is not inside of what the centres span
    balls = reach * covars.diagonal(dim1=1, dim2=2).sum(dim=1).sqrt()
    near = torch.zeros_like(balls, dtype=torch.bool)
    for normal in axes:
        height = means @ normal
        near |= height + balls >= height.max()
    means, covars, reach = means[near], covars[near], reach[near]
    squares = (axes[:, :, None] * axes[:, None]).reshape(-1, 9)
    wide = (covars.reshape(-1, 9) @ squares.T).clamp_min(torch.finfo(means.dtype).tiny).sqrt()
    first = (means @ axes.T + reach[:, None] * wide).argmax(dim=0)
    half = reach[first] / wide[first, torch.arange(len(axes))]
    return means[first] + half[:, None] * torch.einsum("kij,kj->ki", covars[first], axes)
