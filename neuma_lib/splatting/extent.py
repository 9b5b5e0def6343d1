"""Visible extent of Gaussians, which is larger than that of their centres."""

import numpy as np
import torch
from torch import Tensor

from neuma_lib.splatting.viewpoints import sphere_directions

SEEN = 0.05  # alpha at the border of a Gaussian
DIRECTIONS = 100
"""Number of tangent planes in addition to those normal to the axes. Ellipsoids exceed the convex hull by a few percent
of their largest half-axis."""


def outermost(means: Tensor, covars: Tensor, opacities: Tensor) -> Tensor:
    """Points (K, 3) [m] whose convex hull contains nearly all of the visible part of Gaussians.

    A Gaussian of opacity o is visible up to the ellipsoid with o exp(-r^2 / 2) = `SEEN`. The points are those where
    planes, with `DIRECTIONS` normals on the sphere and the six axes, touch the outermost ellipsoids.

    Args:
        means: (G, 3) [m].
        covars: (G, 3, 3) [m^2].
        opacities: (G,) in [0, 1]; those below `SEEN` are ignored. The result is empty if all are.
    """
    visible = opacities > SEEN
    means, covars = means[visible].double(), covars[visible].double()
    if not len(means):
        return means
    reach = (2 * (opacities[visible].double() / SEEN).log()).sqrt()
    axes = torch.from_numpy(np.concatenate([np.eye(3), -np.eye(3), sphere_directions(DIRECTIONS)])).to(means)
    # exclude Gaussians whose bounding ball is inside the extent of the centres
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
