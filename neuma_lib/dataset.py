"""Ground truth of a synthetic benchmark: a known shape of a known material, simulated by the same MPM.

Only evaluation and the particle-supervised ablation may read what this module makes. It uses more particles than the
reconstruction, another seed and an analytic law, so that no later stage can meet its own discretisation again.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
import trimesh
from torch import Tensor

from neuma_lib.geometry.volume import sample_tracers, sample_volume
from neuma_lib.materials.base import Law
from neuma_lib.sim import MPMModel, Trajectory, rollout


@dataclass(frozen=True)
class GroundTruth:
    """A simulated object.

    Attributes:
        frames: simulation steps of the frames, length T.
        path: particle states at the frames (x [m], v [m/s], F), n particles.
        tracers: passive tracers from a jittered grid in the true shape [m], shape (T, M, 3).
        tracers_again: tracers from another jittered grid, shape (T, M, 3): their distance to ``tracers`` is the
            sampling floor of the Chamfer distance.
        vol0: particle volume [m^3].
        mass: particle mass [kg].
    """

    frames: tuple[int, ...]
    path: Trajectory
    tracers: Tensor
    tracers_again: Tensor
    vol0: float
    mass: float


def simulate_ground_truth(
    model: MPMModel,
    law: Law,
    mesh: trimesh.Trimesh,
    v0: Sequence[float],
    density: float,
    frames: Sequence[int],
    *,
    particles: int,
    tracers: int,
    seed: int,
) -> GroundTruth:
    """Fill a placed watertight mesh with particles and simulate it.

    Args:
        model: simulator constants.
        law: analytic material.
        mesh: the true shape where it starts [m].
        v0: initial velocity [m/s].
        density: [kg/m^3].
        frames: steps to keep, 0 is the start.
        particles, tracers: wanted counts.
        seed: of particle and tracer positions.

    Raises:
        InputError: the mesh is not watertight, lies outside the domain, or the time step is too large for the law.
    """
    model.check_courant(law, density)
    points = sample_volume(mesh, particles, seed=seed)
    x0 = torch.as_tensor(points, dtype=torch.float32)
    start = [
        torch.as_tensor(sample_tracers(mesh, tracers, seed=seed + 1 + k), dtype=torch.float32)
        for k in range(2)
    ]
    vol0 = float(mesh.volume) / len(x0)
    share = torch.full((len(x0),), vol0, dtype=torch.float32)
    with torch.no_grad():
        path = rollout(
            model,
            law,
            x0,
            torch.as_tensor(v0, dtype=torch.float32),
            share * density,
            share,
            steps=max(frames),
            frames=frames,
            tracers=torch.cat(start),
        )
    split = len(start[0])
    return GroundTruth(
        frames=tuple(frames),
        path=path,
        tracers=path.tracers[:, :split],
        tracers_again=path.tracers[:, split:],
        vol0=vol0,
        mass=vol0 * density,
    )
