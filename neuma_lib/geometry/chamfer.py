"""Chamfer distance of two point sets, as a measure (paper Sec. 4.1) and as a loss."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from scipy.spatial import cKDTree
from torch import Tensor

from neuma_lib.errors import InputError, NonFiniteError

CHAMFER_SCALE = 1e4
"""The paper reports squared metres times this."""


def _points(points: Tensor | np.ndarray, name: str) -> np.ndarray:
    array = points.detach().cpu().numpy() if isinstance(points, Tensor) else np.asarray(points)
    if array.ndim != 2 or array.shape[1] != 3 or len(array) == 0:
        raise InputError(f"chamfer: {name} has shape {array.shape}; expected a non-empty (n, 3)")
    if not np.isfinite(array).all():
        raise InputError(f"chamfer: {name} holds values that are not finite")
    return array


def chamfer(a: Tensor | np.ndarray, b: Tensor | np.ndarray) -> float:
    """Chamfer distance of points a (n, 3) and b (m, 3) [m], in 1e-4 m^2.

    Raises:
        InputError: an empty set, a wrong shape, or values that are not finite.
    """
    a, b = _points(a, "the first set"), _points(b, "the second set")
    to_b, _ = cKDTree(b).query(a)
    to_a, _ = cKDTree(a).query(b)
    return CHAMFER_SCALE * float(np.mean(to_b**2) + np.mean(to_a**2))


def chamfer_sequence(a: Tensor, b: Tensor) -> Tensor:
    """Chamfer distance of each frame: a (T, n, 3) and b (T, m, 3) [m] -> (T,) in 1e-4 m^2, float64."""
    if len(a) != len(b):
        raise InputError(f"chamfer: {len(a)} frames against {len(b)}")
    return torch.tensor([chamfer(one, other) for one, other in zip(a, b, strict=True)], dtype=torch.float64)


def chamfer_loss(x: Tensor, targets: Tensor | Sequence[Tensor]) -> Tensor:
    """Chamfer distance [m^2] of each frame, differentiable in x.

    The nearest neighbours are found by a KD-tree and held fixed in the gradient, which is exact where no
    point is equally near to two others.

    Args:
        x: simulated particles [m], shape (T, N, 3).
        targets: points to match [m], T sets of shape (M, 3), where M may differ from set to set.

    Returns:
        Losses, shape (T,).

    Raises:
        InputError: another number of frames than targets.
        NonFiniteError: a particle that is not finite.
    """
    if len(x) != len(targets):
        raise InputError(f"chamfer_loss: {len(x)} frames against {len(targets)}")
    positions = x.detach().cpu().numpy()
    finite = np.isfinite(positions).all(axis=2)
    if not finite.all():
        frame, particle = np.argwhere(~finite)[0]
        raise NonFiniteError("chamfer_loss", f"particle {particle} of frame {frame} is not finite")
    losses = []
    for t in range(len(x)):
        goal = targets[t].to(x)
        there = goal.detach().cpu().numpy()
        nearest_goal = torch.from_numpy(cKDTree(there).query(positions[t])[1]).to(x.device)
        nearest_x = torch.from_numpy(cKDTree(positions[t]).query(there)[1]).to(x.device)
        forward = (x[t] - goal[nearest_goal]).square().sum(-1).mean()
        backward = (x[t][nearest_x] - goal).square().sum(-1).mean()
        losses.append(forward + backward)
    return torch.stack(losses)
