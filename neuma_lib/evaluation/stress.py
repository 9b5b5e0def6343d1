"""Errors of a law's stresses on the states of a motion.

The states come from the true law on the reconstruction, so that laws are compared on deformations that the video can
show, with the same particles, start and grid. Elastic F and trial F of single steps test the two parts of a law
separately. Laws may divide a deformation differently into elastic F and flow: a stiffer one that yields at a smaller
strain can have the same stress. Only the stress along a path of total deformation affects the motion, where each law
updates its own elastic F from the start.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from neuma_lib.errors import InputError
from neuma_lib.evaluation.material_point import returned, stress
from neuma_lib.mechanics.law import Law
from neuma_lib.sim.model import MPM
from neuma_lib.sim.rollout import rollout
from neuma_lib.sim.state import State

STRAINED = 1e-4  # component of F - I above which a body counts as deformed, which marks its first contact
PARTS = {
    "stress": "Kirchhoff stress of the visited elastic states",
    "volumetric": "Its volumetric part, the mean of the normal stresses",
    "deviatoric": "Its deviatoric part",
    "returned": "Stress of the visited trial states after the return map of a step",
    "path": "Stress along the visited paths of total deformation, every law with its own elastic state",
}
"""Stresses that `stress_errors` compares."""


@dataclass(frozen=True)
class VisitedStates:
    """Deformations of material points during a motion."""

    F: Tensor  # elastic deformation gradients, shape (S, 3, 3)
    F_trial: Tensor  # the same before the return map, shape (S, 3, 3)
    # velocity gradients of P points at steps 0 to T - 1 [1/s], shape (T, P, 3, 3). Step n applies I + dt C_n.
    C: Tensor
    # steps after the first contact at which the stresses of these points are compared
    frames: tuple[int, ...]

    @classmethod
    def of_arrays(cls, arrays: Mapping[str, np.ndarray]) -> "VisitedStates":
        """Inverse of `arrays`."""
        values = (torch.from_numpy(arrays[name]) for name in ("F", "F_trial", "C"))
        return cls(*values, tuple(arrays["frames"].tolist()))

    def arrays(self) -> dict[str, np.ndarray]:
        """The states as arrays by name, for a file."""
        values = {name: getattr(self, name).numpy() for name in ("F", "F_trial", "C")}
        return {**values, "frames": np.asarray(self.frames)}


def visit(
    model: MPM, law: Law, start: State, frames: Sequence[int], states: int, paths: int, seed: int
) -> VisitedStates:
    """Simulate a law and sample states of its motion.

    Args:
        start: particles with their initial motion.
        frames: steps of the video's frames. States are sampled uniformly from those after the first contact.
        states: S, sampled independently, with particles in proportion to their volumes.
        paths: P, sampled the same way without replacement, at most one for each particle.

    Raises:
        InputError: nothing is deformed up to the last frame.
        NonFiniteError: the rollout diverges.
    """
    with torch.no_grad():
        motion = rollout(model, law, start, steps=frames[-1], frames=range(frames[-1] + 1)).cpu()
    F, C = motion.F, motion.C
    deformed = deformed_frames(F)
    if not deformed[[n for n in frames if n > 0]].any():
        problem = f"no particle is deformed up to step {frames[-1]}, so there are no stresses to compare"
        raise InputError("frames", problem, "Extend the video until after the first contact")
    first = max(1, int(deformed.int().argmax()))
    after = torch.tensor([n for n in frames if n >= first])
    generator, volumes = torch.Generator().manual_seed(seed), start.vol0.cpu()
    p = volumes.multinomial(states, replacement=True, generator=generator)
    n = after[torch.randint(len(after), (states,), generator=generator)]
    points = volumes.multinomial(min(paths, len(volumes)), generator=generator)
    before = F[n - 1, p]
    return VisitedStates(F[n, p], before + model.dt * (C[n, p] @ before), C[:, points], tuple(after.tolist()))


def deformed_frames(F: Tensor) -> Tensor:
    """Frames (T,) in which a body with elastic deformation gradients F (T, N, 3, 3) is deformed by `STRAINED`."""
    return (F - torch.eye(3, dtype=F.dtype)).abs().amax(dim=(1, 2, 3)) > STRAINED


def stress_errors(law: Law, truth: Law, visited: VisitedStates, dt: float) -> dict[str, float | int | None]:
    """Errors of a law's stresses, relative to the true ones.

    Returns:
        for each of `PARTS`, root mean square of the error over that of the true stress; ``asymmetric``, the same for
        the antisymmetric part of the law's stress; ``true_rms``, root mean square of the true stress [Pa];
        ``broken_paths``, number of paths on which the law's stress became non-finite. ``path`` leaves these out and is
        None without other paths.
    """
    F, F_trial = visited.F.double(), visited.F_trial.double()
    tau, true = stress(law, F), stress(truth, F)
    volumetric, true_volumetric = (_volumetric(t) for t in (tau, true))
    after, true_after = (stress(each, returned(each, F_trial)) for each in (law, truth))
    along, true_along = (_along(each, visited, dt) for each in (law, truth))
    sound = along.isfinite().all(dim=-1).all(dim=-1).all(dim=0)
    return {
        "stress": _relative(tau, true),
        "volumetric": _relative(volumetric, true_volumetric),
        "deviatoric": _relative(tau - volumetric, true - true_volumetric),
        "returned": _relative(after, true_after),
        "path": _relative(along[:, sound], true_along[:, sound]) if sound.any() else None,
        "asymmetric": _rms(0.5 * (tau - tau.mT)) / _rms(true),
        "true_rms": _rms(true),
        "broken_paths": int((~sound).sum()),
    }


def _along(law: Law, visited: VisitedStates, dt: float) -> Tensor:
    """Stresses (frames, P, 3, 3) of a law along the paths, NaN after a path becomes non-finite."""
    F = torch.eye(3, dtype=torch.float64).expand(visited.C.shape[1], 3, 3)
    wanted, stresses = set(visited.frames), []
    broken = torch.zeros(len(F), dtype=torch.bool)
    for step, C in enumerate(visited.C.double()):
        F = returned(law, F + dt * (C @ F)) if step else F
        broken = broken | ~F.isfinite().all(dim=-1).all(dim=-1)
        F = torch.where(broken[:, None, None], torch.eye(3, dtype=F.dtype), F)
        if step in wanted:
            stresses.append(torch.where(broken[:, None, None], torch.nan, stress(law, F)))
    return torch.stack(stresses)


def _volumetric(tau: Tensor) -> Tensor:
    mean = tau.diagonal(dim1=-2, dim2=-1).mean(dim=-1)
    return mean[..., None, None] * torch.eye(3, dtype=tau.dtype)


def _rms(values: Tensor) -> float:
    return float(values.square().sum(dim=(-2, -1)).mean().sqrt())


def _relative(values: Tensor, true: Tensor) -> float:
    return _rms(values - true) / _rms(true)
