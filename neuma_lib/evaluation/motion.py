"""Evaluate a predicted motion: rollout from the estimated start, compared with the ground truth.

The main measure is the distance of tracers from the true positions of tracers with the same start. The Chamfer distance
between filled volumes (paper Sec. 4.1) depends on silhouettes only: of points displaced by d, those within d of the
surface contribute, so it grows with the cube of d and ignores the rotation of a ball. It also contains a sampling
floor, the distance between two sets of points of the same body, which decreases with their density. The excess is the
distance without the floor.
"""

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Protocol

import torch
from torch import Tensor

from neuma_lib.errors import InputError
from neuma_lib.evaluation.metrics import mechanical_energy, tracer_errors
from neuma_lib.geometry.chamfer import chamfer_sequence
from neuma_lib.sim.model import MPM
from neuma_lib.sim.prediction import Failure
from neuma_lib.sim.state import State, Trajectory

COUNT_TOLERANCE = 0.1
"""Maximum relative difference of the counts of two jittered sets of points, each within 5 % of the requested count."""
ENERGY_TOLERANCE = 0.01
"""Maximum gain of a passive body relative to its initial energy. The error of the integrator is smaller."""


@dataclass(frozen=True)
class Evaluation:
    """Result of `evaluate`.

    Attributes:
        path: predicted particle states at the frames, with the total deformation if requested.
        tracers: tracers that started in the reconstructed shape [m], shape (T, M, 3).
        metrics: plain numbers and lists for ``metrics.json``.
    """

    path: Trajectory
    tracers: Tensor
    metrics: dict

    def summary(self) -> str:
        """One line for the log."""
        m = self.metrics
        text = (
            f"tracer RMSE {m['tracer_rmse_mm']:.2f} mm (95 % below {m['tracer_error_p95_mm']:.2f}, last frame "
            f"{m['tracer_rmse_last_mm']:.2f}), Chamfer {m['chamfer']:.3f}e-4 m^2 (floor {m['chamfer_floor']:.3f})"
        )
        if failure := m["diverged"]:
            text += f"; DIVERGED: a particle {failure['happened']} at step {failure['step']}"
        return text


def energy_gain_after(gravity: Sequence[float], start: State, path: Trajectory) -> int | None:
    """The last frame of a path before its energy first exceeds the initial energy. None if it never does.

    The kinetic and gravitational energy of a passive body never exceeds its initial value. A gain by more than
    `ENERGY_TOLERANCE` marks the beginning of an instability.
    """
    x, v, *_ = start.motion
    allowed = (1 + ENERGY_TOLERANCE) * mechanical_energy(x, v, start.mass, gravity)
    more = mechanical_energy(path.x, path.v, start.mass, gravity) > allowed
    if not more.any():
        return None
    first = int(more.nonzero()[0])
    return path.frames[first - 1] if first else 0


class Predictor(Protocol):
    """A model that predicts a motion, see `neuma_lib.methods.model`."""

    def predict(
        self, mpm: MPM, state: State, frames: Sequence[int], tracers: Tensor | None, total: bool
    ) -> tuple[Trajectory, Failure | None]: ...

    def courant(self, mpm: MPM, state: State) -> float | None: ...


def evaluate(
    mpm: MPM,
    motion: Predictor,
    start: State,
    frames: Sequence[int],
    truth: Tensor,
    truth_again: Tensor,
    tracers: Tensor,
    total: bool = False,
    floor: Tensor | None = None,
    owners: Tensor | None = None,
) -> Evaluation:
    """Tracer error from identical starts, Chamfer distance over the sequence, and its sampling floor.

    Args:
        mpm: simulator constants.
        motion: model to evaluate.
        start: reconstructed particles with the estimated initial motion.
        frames: simulation steps, T of them.
        truth: tracers of the ground truth [m], shape (T, M, 3).
        truth_again: tracers of the ground truth from another sampling of the shape [m], shape (T, M'', 3).
        tracers: start positions inside the reconstructed shape [m], shape (M', 3).
        total: also carry the total deformation.
        floor: Chamfer distances between the truth's two sets of points, shape (T,). None: computed here.
        owners: body of each true tracer, shape (M,), for the tracer errors of each body in ``metrics["bodies"]``. None:
            one body.

    Raises:
        InputError: counts of tracers that differ by more than `COUNT_TOLERANCE`. The floor holds for equal counts.
    """
    counts = [truth.shape[1], truth_again.shape[1], len(tracers)]
    if max(counts) > (1 + COUNT_TOLERANCE) * min(counts):
        raise InputError(
            "evaluation.tracers",
            f"the truth has {counts[0]} and {counts[1]} tracers, the prediction has {counts[2]}, and the sampling "
            "floor holds for equal counts",
            "Set it to the dataset.tracers of the truth",
        )
    path, failure = motion.predict(mpm, start, frames, torch.cat([tracers, truth[0].to(tracers)]), total)
    ours, same_start = path.tracers[:, : len(tracers)], path.tracers[:, len(tracers) :]
    chamfer = chamfer_sequence(ours, truth)
    floor = chamfer_sequence(truth_again, truth) if floor is None else floor
    bodies = [] if owners is None else [owners == k for k in range(int(owners.max()) + 1)]
    metrics = {
        **tracer_errors(same_start, truth),
        **(
            {"bodies": [tracer_errors(same_start[:, own], truth[:, own]) for own in bodies]} if bodies else {}
        ),
        "chamfer": float(chamfer.mean()),
        "chamfer_floor": float(floor.mean()),
        "chamfer_excess": float((chamfer - floor).mean()),
        "chamfer_unit": "1e-4 m^2",
        "frames": list(frames),
        "chamfer_per_frame": [float(c) for c in chamfer],
        "chamfer_floor_per_frame": [float(c) for c in floor],
        "courant": motion.courant(mpm, start),
        "energy_gain_after_step": energy_gain_after(mpm.gravity, start, path),
        "diverged_at_step": failure and failure.step,
        "diverged": failure and asdict(failure),
    }
    return Evaluation(path, ours, metrics)
