"""How well fitted springs predict the motion: the measures of `neuma_lib.evaluation.motion`, of what follows them."""

from __future__ import annotations

from collections.abc import Sequence

from torch import Tensor

from neuma_lib.evaluation.motion import Evaluation, Failure, judge, sound_frames
from neuma_lib.sim.state import State, Trajectory
from neuma_lib.springs.body import SpringBody
from neuma_lib.springs.interpolation import Interpolation
from neuma_lib.springs.network import Springs
from neuma_lib.springs.rollout import SpringModel, spring_rollout


def predict_springs(
    model: SpringModel,
    body: SpringBody,
    springs: Springs,
    start: State,
    frames: Sequence[int],
    tracers: Tensor,
    carriers: int,
) -> tuple[Trajectory, Failure | None]:
    """States of the body's particles at the frames, and its tracers; held at the last sound frame.

    Args:
        start: the particles and their initial motion.
        tracers: start positions [m], shape (M, 3).
        carriers: anchors that a tracer follows.
    """
    follow = Interpolation(tracers, body.network.anchors, carriers)

    def simulate(kept: Sequence[int]) -> Trajectory:
        x, v, _ = spring_rollout(model, springs, *body.start(start), kept)
        return body.path(tuple(kept), x, v, follow(x)[0])

    return sound_frames(simulate, frames)


def evaluate_springs(
    model: SpringModel,
    body: SpringBody,
    springs: Springs,
    start: State,
    frames: Sequence[int],
    truth: Tensor,
    truth_again: Tensor,
    tracers: Tensor,
    carriers: int,
    floor: Tensor | None = None,
) -> Evaluation:
    """As `motion.evaluate`, with springs in place of a law. They have no Courant number of the grid."""

    def predicted(starts: Tensor) -> tuple[Trajectory, Failure | None]:
        return predict_springs(model, body, springs, start, frames, starts, carriers)

    gravity = model.gravity
    return judge(predicted, lambda: None, start, gravity, frames, truth, truth_again, tracers, floor)
