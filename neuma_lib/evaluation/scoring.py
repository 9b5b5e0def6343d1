"""Score predicted positions of any method by the measures of `neuma_lib.evaluation.motion`."""

from collections.abc import Sequence

import numpy as np
from scipy.spatial import cKDTree
from torch import Tensor

from neuma_lib.errors import InputError
from neuma_lib.evaluation.metrics import tracer_errors
from neuma_lib.geometry.chamfer import chamfer_sequence

SAME_START = 1e-4
"""Maximum distance of a predicted point from a true tracer at the first frame to be the same point [m]."""

MIN_POINTS = 100  # minimum number of points of a Chamfer distance


def score_positions(
    x: Tensor,
    truth: Tensor,
    truth_again: Tensor,
    frames: Sequence[int] | None = None,
    steps: Sequence[int] = (),
) -> dict[str, float]:
    """Tracer errors, Chamfer distance, its sampling floor and the excess of predicted positions.

    Points that start where the true tracers do are compared one by one. The others are a sampling of the body, whose
    Chamfer distance from the tracers is measured. Without others, it is that of the tracers from the second sampling of
    the true body, so that two independent samplings are compared in each case. The floor is that of an equal number of
    points of the truth, which are drawn if there are more.

    Args:
        x: predicted positions [m], shape (T, N, 3).
        truth, truth_again: two samplings of the true body [m], shapes (T, M, 3) and (T, M', 3).
        frames: simulation steps of the prediction, None if unknown.
        steps: those of the truth.

    Returns:
        ``tracer_rmse_mm``, ``tracer_error_p95_mm`` and ``tracer_rmse_last_mm``, unless tracers are missing;
        ``chamfer``, ``chamfer_floor`` and ``chamfer_excess`` [1e-4 m^2]; ``points``, their number for the distance.

    Raises:
        InputError: other frames than those of the truth, or fewer than `MIN_POINTS`.
    """
    if len(x) != len(truth) or frames is not None and list(frames) != list(steps):
        given = f"{len(x)} frames" if frames is None else f"{len(x)} frames at steps {_ends(frames)}"
        problem = f"{given} must be the {len(truth)} of the truth at steps {_ends(steps)}"
        raise InputError("positions", problem)
    x, truth, truth_again = x.double(), truth.double(), truth_again.double()
    distance, same = cKDTree(x[0].numpy()).query(truth[0].numpy())
    metrics, own = {}, np.arange(x.shape[1])
    if distance.max() <= SAME_START and len(np.unique(same)) == len(same):
        errors = tracer_errors(x[:, same], truth)
        metrics = {name: value for name, value in errors.items() if not isinstance(value, list)}
        own = np.setdiff1d(own, same)
    reference, other = truth, truth_again
    if metrics and len(own) < MIN_POINTS:
        own, reference, other = same, truth_again, truth
    if len(own) < MIN_POINTS:
        problem = f"{len(own)} points are fewer than {MIN_POINTS}, and are not those of the true tracers"
        raise InputError(
            "positions", problem, "Predict the points of starts.ply, or fill the body with points"
        )
    count, draw = min(len(own), other.shape[1]), np.random.default_rng(0)
    own, others = (np.sort(draw.choice(rows, count, replace=False)) for rows in (own, other.shape[1]))
    other = other[:, others]
    chamfer, floor = chamfer_sequence(x[:, own], reference), chamfer_sequence(other, reference)
    metrics |= {"chamfer": float(chamfer.mean()), "chamfer_floor": float(floor.mean())}
    return metrics | {"chamfer_excess": float((chamfer - floor).mean()), "points": len(own)}


def _ends(steps: Sequence[int]) -> str:
    return f"{steps[0]} to {steps[-1]}" if len(steps) else "none"
