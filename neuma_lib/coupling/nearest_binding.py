"""Binding without additional particles, for splats with many more and smaller Gaussians than particles.

Algorithm 1 of the paper adds a particle at the centre of every Gaussian that contains none. A splat of photographs or
of an image-to-3D model has tens of thousands of such Gaussians on the surface, which would dominate the simulation.
"""

import numpy as np
import torch
from scipy.spatial import cKDTree
from torch import Tensor

from neuma_lib.config.binding import BindingConfig
from neuma_lib.coupling.binding import Binding
from neuma_lib.coupling.particle_binding import bind
from neuma_lib.errors import InputError

ENOUGH = 4  # minimum number of particles in a Gaussian's ellipsoid for a binding by Algorithm 1
NEAREST = 10  # number of particles bound to a Gaussian with fewer


def bind_nearest(
    means: Tensor, covars: Tensor, particles: Tensor, settings: BindingConfig | None = None
) -> Binding:
    """The first pass of Algorithm 1, with the nearest particles for Gaussians with too few.

    Weights of the nearest particles decrease smoothly to zero at the distance of the next one. Use `deform` with arms,
    because such Gaussians are outside their particles.

    Args:
        means, covars, particles, settings: see `bind`.

    Raises:
        InputError: see `bind`; too few particles.
    """
    if len(particles) <= NEAREST:
        raise InputError("binding: particles", f"{len(particles)} are too few, {NEAREST + 1} are needed")
    first = bind(means, covars, particles, settings)
    isolated = (first.counts < ENOUGH).cpu().numpy()
    points, centres = particles.double().cpu().numpy(), means.double().cpu().numpy()[isolated]
    distance, index = cKDTree(points).query(centres, k=NEAREST + 1)
    weights = np.square(1 - np.square(distance[:, :-1] / distance[:, -1:].clip(1e-30)))
    weights = np.where(weights.sum(axis=1, keepdims=True) > 0, weights, 1.0)
    weights /= weights.sum(axis=1, keepdims=True)
    order = np.argsort(index[:, :-1], axis=1)
    rows = np.repeat(np.arange(len(means)), first.counts.cpu().numpy())
    kept = ~isolated[rows]
    rows = np.concatenate([rows[kept], np.repeat(np.flatnonzero(isolated), NEAREST)])
    columns = np.concatenate([first.indices.cpu().numpy()[kept], np.take_along_axis(index, order, 1).ravel()])
    values = np.concatenate([first.values.cpu().numpy()[kept], np.take_along_axis(weights, order, 1).ravel()])
    by_row = np.argsort(rows, kind="stable")
    counts = np.bincount(rows, minlength=len(means))
    return Binding(
        torch.from_numpy(np.concatenate([[0], np.cumsum(counts)])).to(means.device),
        torch.from_numpy(columns[by_row]).to(means.device),
        torch.from_numpy(values[by_row]).to(means),
        (len(means), len(points)),
    )
