"""How well a law predicts the motion: rollout from the estimated start, compared with the ground truth.

What counts is how far tracers are from where the truth takes them from the same start. The Chamfer distance between
filled volumes (paper Sec. 4.1) sees their outlines only: of points that are d apart those within d of the surface are
noticed, so it grows with the cube of d, and a ball that has turned is no other ball. It also contains a sampling floor:
two samplings of one and the same body are apart, by less the denser they are. The excess is what remains without it.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from typing import Protocol

import torch
from torch import Tensor

from neuma_lib.errors import InputError, NonFiniteError
from neuma_lib.evaluation.metrics import mechanical_energy, tracer_errors
from neuma_lib.geometry.chamfer import chamfer_sequence
from neuma_lib.mechanics.law import Law
from neuma_lib.sim.model import MPM, MaterialRegion
from neuma_lib.sim.rollout import rollout
from neuma_lib.sim.state import State, Trajectory

COUNT_TOLERANCE = 0.1
"""Two jittered samplings of the same wanted count differ by at most this fraction: each keeps to 5 % of it."""
ENERGY_TOLERANCE = 0.01
"""Fraction of the energy at the start by which no passive body exceeds it (the integrator's own error is smaller)."""


@dataclass(frozen=True)
class Failure:
    """Where a prediction ended before its last frame.

    Attributes:
        happened: what a particle did: "became non-finite", "moved by more than a cell in a step", "left the grid".
        step: simulation step in which it did.
        particle: the first particle that did.
    """

    happened: str
    step: int | None
    particle: int | None


@dataclass(frozen=True)
class Evaluation:
    """Result of `evaluate`.

    Attributes:
        path: predicted particle states at the frames, with the total deformation if it was asked for.
        tracers: tracers that started in the reconstructed shape [m], shape (T, M, 3).
        metrics: plain numbers and lists for ``metrics.json``.
    """

    path: Trajectory
    tracers: Tensor
    metrics: dict

    def summary(self) -> str:
        """One line for people."""
        m = self.metrics
        said = (
            f"tracer RMSE {m['tracer_rmse_mm']:.2f} mm (95 % below {m['tracer_error_p95_mm']:.2f}, last frame "
            f"{m['tracer_rmse_last_mm']:.2f}), Chamfer {m['chamfer']:.3f}e-4 m^2 (floor {m['chamfer_floor']:.3f})"
        )
        if failure := m["diverged"]:
            said += f"; DIVERGED: a particle {failure['happened']} at step {failure['step']}"
        return said


def predict(
    model: MPM,
    law: Law | Sequence[MaterialRegion],
    start: State,
    frames: Sequence[int],
    tracers: Tensor | None = None,
    total: bool = False,
) -> tuple[Trajectory, Failure | None]:
    """Rollout of a law; one that becomes unstable is held at its last sound frame.

    Args:
        start: particles and their initial motion.
        frames: simulation steps of the frames, T of them.
        tracers: start positions of passive tracers [m], shape (M, 3).
        total: also carry the total deformation.

    Returns:
        The trajectory at the frames, and how it failed (None: it did not).
    """
    return sound_frames(
        lambda kept: rollout(model, law, start, steps=kept[-1], frames=kept, tracers=tracers, total=total),
        frames,
    )


def sound_frames(
    simulate: Callable[[Sequence[int]], Trajectory], frames: Sequence[int]
) -> tuple[Trajectory, Failure | None]:
    """What a simulation gives up to its last sound frame, held from there on, and how it failed (None: it did not).

    Args:
        simulate: called with the frames that are wanted; raises NonFiniteError where one of them is not sound.
        frames: simulation steps of all frames.
    """
    kept, failure = list(frames), None
    while True:
        try:
            with torch.no_grad():
                path = simulate(kept)
            break
        except NonFiniteError as error:
            failure = failure or Failure(error.happened, error.step, error.particle)
            kept = kept[:-1] if error.step is None else [n for n in kept if n < error.step]
            if not kept:
                raise
    missing = len(frames) - len(kept)
    return path.hold_last(missing) if missing else path, failure


def energy_gain_after(gravity: Sequence[float], start: State, path: Trajectory) -> int | None:
    """The last step of a path up to which no more energy was seen than at the start; None if there never was more.

    A body without a motor turns its kinetic and gravitational energy into others and back, and never has more of it
    than at the start: one that does, by `ENERGY_TOLERANCE`, has begun to go wrong. Seen at the path's frames.
    """
    x, v, *_ = start.motion
    allowed = (1 + ENERGY_TOLERANCE) * mechanical_energy(x, v, start.mass, gravity)
    more = mechanical_energy(path.x, path.v, start.mass, gravity) > allowed
    if not more.any():
        return None
    first = int(more.nonzero()[0])
    return path.frames[first - 1] if first else 0


class Predictor(Protocol):
    """What predicts a motion: a model of `neuma_lib.methods.model`."""

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
        floor: Chamfer distances between the truth's two samplings, shape (T,). None: computed here.

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
    metrics = {
        **tracer_errors(same_start, truth),
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
