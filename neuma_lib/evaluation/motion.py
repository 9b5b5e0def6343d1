"""How well a law predicts the motion: rollout from the estimated start, compared with the ground truth.

The Chamfer distance between filled volumes contains a sampling floor: two samplings of one and the same body are apart,
by less the denser they are. The excess is what remains of the distance without it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from neuma_lib.coupling.reconstruction import Reconstruction
from neuma_lib.errors import NonFiniteError
from neuma_lib.evaluation.metrics import tracer_rmse
from neuma_lib.geometry.chamfer import chamfer_sequence
from neuma_lib.mechanics.law import Law
from neuma_lib.sim.model import Body, MPMModel, as_bodies
from neuma_lib.sim.rollout import rollout
from neuma_lib.sim.state import Trajectory
from neuma_lib.sim.total_deformation import every_step, total_deformation


@dataclass(frozen=True)
class Evaluation:
    """Result of `evaluate`.

    Attributes:
        path: predicted particle states at the frames.
        tracers: tracers that started in the reconstructed shape [m], shape (T, M, 3).
        metrics: plain numbers and lists for ``metrics.json``.
        F_total: total deformation gradients (`total_deformation`), shape (T, N, 3, 3); None if not asked for.
    """

    path: Trajectory
    tracers: Tensor
    metrics: dict
    F_total: Tensor | None = None

    def summary(self) -> str:
        """One line for people."""
        m = self.metrics
        note = "" if m["diverged_at_step"] is None else f"; DIVERGED at step {m['diverged_at_step']}"
        return (
            f"Chamfer {m['chamfer']:.3f}e-4 m^2 (floor {m['chamfer_floor']:.3f}, excess {m['chamfer_excess']:.3f}), "
            f"tracer RMSE {m['tracer_rmse_mm']:.2f} mm{note}"
        )


def predict(
    model: MPMModel,
    law: Law | Sequence[Body],
    body: Reconstruction,
    v0: Tensor,
    frames: Sequence[int],
    tracers: Tensor | None = None,
) -> tuple[Trajectory, int | None]:
    """Rollout of a law; one that becomes non-finite is held at its last finite frame.

    Args:
        frames: simulation steps of the frames, T of them.
        tracers: start positions of passive tracers [m], shape (M, 3).

    Returns:
        The trajectory at the frames, and the step at which it became non-finite (None: it did not).
    """
    kept, failed_at = list(frames), None
    while True:
        try:
            with torch.no_grad():
                path = rollout(model, law, body.state(v0), steps=kept[-1], frames=kept, tracers=tracers)
            break
        except NonFiniteError as error:
            failed_at = error.step if failed_at is None else failed_at
            kept = kept[:-1] if error.step is None else [n for n in kept if n < error.step]
            if not kept:
                raise
    missing = len(frames) - len(kept)
    return path.hold_last(missing) if missing else path, failed_at


def evaluate(
    model: MPMModel,
    law: Law | Sequence[Body],
    body: Reconstruction,
    v0: Tensor,
    frames: Sequence[int],
    truth: Tensor,
    truth_again: Tensor,
    tracers: Tensor,
    total: bool = False,
) -> Evaluation:
    """Chamfer distance over the sequence, its sampling floor, and the tracer error from identical starts.

    Args:
        model: simulator constants.
        law: material to judge, or several with their ranges of particles.
        body: reconstructed particles.
        v0: estimated velocity [m/s], shape (3,) or (N, 3).
        frames: simulation steps, T of them.
        truth: tracers of the ground truth [m], shape (T, M, 3).
        truth_again: tracers of the ground truth from another sampling of the shape, shape (T, M, 3).
        tracers: start positions inside the reconstructed shape [m], shape (M', 3).
        total: also compute the total deformation.
    """
    starts = torch.cat([tracers, truth[0].to(tracers)])
    path, failed_at = predict(model, law, body, v0, every_step(frames) if total else frames, starts)
    F_total = total_deformation(path, model.dt, frames).F if total else None
    path = path.at(frames) if total else path
    predicted, same_start = path.tracers[:, : len(tracers)], path.tracers[:, len(tracers) :]
    chamfer = chamfer_sequence(predicted, truth)
    floor = chamfer_sequence(truth_again, truth)
    density = body.mass / body.vol0
    rmse = 1e3 * tracer_rmse(same_start, truth)
    metrics = {
        "chamfer": float(chamfer.mean()),
        "chamfer_floor": float(floor.mean()),
        "chamfer_excess": float((chamfer - floor).mean()),
        "chamfer_unit": "1e-4 m^2",
        "tracer_rmse_mm": float((rmse**2).mean().sqrt()),
        "frames": list(frames),
        "chamfer_per_frame": [float(c) for c in chamfer],
        "chamfer_floor_per_frame": [float(c) for c in floor],
        "tracer_rmse_mm_per_frame": [float(e) for e in rmse],
        "courant": max(
            model.courant(part.law, float(density[part.start : part.stop].min()))
            for part in as_bodies(law, len(density))
        ),
        "diverged_at_step": failed_at,
    }
    return Evaluation(path, predicted, metrics, F_total)
