"""Chamfer distance of two point sets, as a metric (paper Sec. 4.1) and as a loss."""

from collections.abc import Sequence

import torch
from torch import Tensor

from neuma_lib.errors import InputError, NonFiniteError
from neuma_lib.geometry.nearest import nearest

CHAMFER_SCALE = 1e4  # factor of squared metres in the paper's unit


def chamfer_sequence(a: Tensor, b: Tensor) -> Tensor:
    """Chamfer distance of each frame: a (T, n, 3) and b (T, m, 3) [m] -> (T,) in 1e-4 m^2, float64, on the CPU.

    Raises:
        InputError: different numbers of frames, no points, or values that are not finite.
    """
    if len(a) != len(b):
        raise InputError("chamfer", f"a has {len(a)} frames, b has {len(b)}")
    for points, name in ((a, "a"), (b, "b")):
        if points.numel() == 0:
            raise InputError(f"chamfer: {name}", "has no points")
        if not bool(points.isfinite().all()):
            raise InputError(f"chamfer: {name}", "has values that are not finite")
    with torch.no_grad():  # one frame at a time, which stays in the caches of a CPU
        means = [chamfer_loss(x[None].double(), y[None].double()) for x, y in zip(a, b, strict=True)]
    return CHAMFER_SCALE * torch.cat(means).cpu()


def chamfer_loss(x: Tensor, targets: Tensor | Sequence[Tensor]) -> Tensor:
    """Chamfer distance [m^2] of each frame, differentiable in x.

    Nearest neighbours are computed for all frames at once on the device of x, and are constant in the gradient, which
    is exact unless a point is equally near to two others.

    Args:
        x: simulated particles [m], shape (T, N, 3).
        targets: points to match [m], T sets of shape (M, 3), where M may differ between sets.

    Returns:
        Losses, shape (T,).

    Raises:
        InputError: different numbers of frames and targets.
        NonFiniteError: a particle is not finite.
    """
    if len(x) != len(targets):
        raise InputError("chamfer_loss", f"x has {len(x)} frames, targets has {len(targets)}")
    finite = x.detach().isfinite().all(dim=2)
    if not bool(finite.all()):
        frame, particle = (~finite).nonzero()[0].tolist()
        raise NonFiniteError("chamfer_loss", f"particle {particle} of frame {frame} is not finite")
    means = [a.mean() + b.mean() for a, b in zip(*_squared_distances(x, targets), strict=True)]
    return torch.stack(means)


def _squared_distances(
    x: Tensor, targets: Tensor | Sequence[Tensor]
) -> tuple[Sequence[Tensor], Sequence[Tensor]]:
    """Squared distances [m^2] of each set of x to the nearest of its targets, and of the targets to the nearest x."""
    counts, target_counts = [x.shape[1]] * len(x), [len(target) for target in targets]
    points, goals = x.reshape(-1, 3), torch.cat([target.to(x) for target in targets])
    fixed = points.detach()
    forward = (points - goals[nearest(goals, target_counts, fixed, counts)]).square().sum(-1)
    backward = (points[nearest(fixed, counts, goals, target_counts)] - goals).square().sum(-1)
    return forward.split(counts), backward.split(target_counts)
