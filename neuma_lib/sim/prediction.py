"""Rollouts that are held at their last valid frame after a failure."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from neuma_lib.errors import NonFiniteError
from neuma_lib.mechanics.law import Law
from neuma_lib.sim.model import MPM, MaterialRegion
from neuma_lib.sim.rollout import rollout
from neuma_lib.sim.state import State, Trajectory


@dataclass(frozen=True)
class Failure:
    """Reason and time of a failed prediction.

    Attributes:
        happened: "became non-finite", "moved by more than a cell in a step" or "left the grid", of a particle.
        step: simulation step of the failure.
        particle: index of the first such particle.
    """

    happened: str
    step: int | None
    particle: int | None


def predict(
    model: MPM,
    law: Law | Sequence[MaterialRegion],
    start: State,
    frames: Sequence[int],
    tracers: Tensor | None = None,
    total: bool = False,
) -> tuple[Trajectory, Failure | None]:
    """Rollout of a law. After a failure the last valid frame is repeated.

    Args:
        start: particles and their initial motion.
        frames: simulation steps of the frames, T of them.
        tracers: start positions of passive tracers [m], shape (M, 3). Each moves with the nearest of several bodies.
        total: also carry the total deformation.

    Returns:
        The trajectory at the frames, and the failure or None.
    """
    by_body, counts = None, ()
    if tracers is not None and start.bodies:
        owner = nearest_body(start, tracers).to(tracers.device)
        by_body = torch.argsort(owner, stable=True)
        counts = owner.bincount(minlength=len(start.bodies)).tolist()
        tracers = tracers[by_body]

    def simulate(kept: Sequence[int]) -> Trajectory:
        options = {"tracers": tracers, "tracer_bodies": counts, "total": total}
        path = rollout(model, law, start, steps=kept[-1], frames=kept, **options)
        return path if by_body is None else replace(path, tracers=path.tracers[:, by_body.argsort()])

    return valid_frames(simulate, frames)


def nearest_body(start: State, points: Tensor) -> Tensor:
    """Index of the body whose particle is nearest to each point (M, 3) [m], shape (M,)."""
    from scipy.spatial import cKDTree  # here, because the import takes an eighth of a second

    owners = torch.arange(len(start.bodies)).repeat_interleave(torch.tensor(start.bodies))
    nearest = cKDTree(start.x.detach().cpu().numpy()).query(points.detach().cpu().numpy())[1]
    return owners[torch.from_numpy(nearest)]


def valid_frames(
    simulate: Callable[[Sequence[int]], Trajectory], frames: Sequence[int]
) -> tuple[Trajectory, Failure | None]:
    """Trajectory of a simulation whose last valid frame is repeated after a failure, and the failure or None.

    Args:
        simulate: called with the frames to simulate. Raises NonFiniteError if it fails before the last of them.
        frames: simulation steps of all frames.

    Raises:
        NonFiniteError: the simulation fails before the first frame.
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
