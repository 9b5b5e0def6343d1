"""Ground-truth motion of a drop."""

from dataclasses import dataclass

import numpy as np
import torch
import trimesh

from neuma_lib.data.ground_truth import GroundTruth, TrueBody, simulate_ground_truth
from neuma_lib.geometry.skinning import skinning_matrix
from neuma_lib.mechanics.analytic import analytic_law
from neuma_lib.sim.model import MPM
from studies.capture_benchmark.settings import DemoCapturesConfig
from studies.capture_benchmark.stage import frame_steps, solid, start, time_step


@dataclass(frozen=True, eq=False)
class Surfaces:
    """Vertices (T, n, 3) [m] and velocities (T, n, 3) [m/s] of the body's surface at simulation steps (T,)."""

    steps: np.ndarray
    vertices: np.ndarray
    velocities: np.ndarray

    def at(self, steps: np.ndarray) -> np.ndarray:
        """Indices of the given steps."""
        return np.searchsorted(self.steps, steps)


def simulate_drop(
    demo: DemoCapturesConfig, name: str, drop: str, device: torch.device | str = "cpu"
) -> GroundTruth:
    """Simulate a drop, with a state at the start and for each frame of each camera."""
    item, settings = demo.objects[name], demo.truth
    initial, dt = item.drops[drop], time_step(demo)
    mesh = solid(item)
    mesh.vertices = start(item, initial, mesh).apply(mesh.vertices)
    model = MPM(grid=settings.grid, dt=dt, gravity=(0.0, -settings.gravity, 0.0))
    law = analytic_law(item.law.plain(), dt=dt)
    frames = sorted({0, *(int(s) for camera in demo.cameras for s in frame_steps(demo, camera))})
    return simulate_ground_truth(
        model,
        [TrueBody(mesh, law, initial.velocity, item.density, initial.spin)],
        frames,
        particles=settings.particles,
        tracers=settings.tracers,
        seed=settings.seed,
        device=device,
    )


def surfaces(rest: trimesh.Trimesh, steps: np.ndarray, x: np.ndarray, v: np.ndarray) -> Surfaces:
    """Surfaces moved by particles.

    Args:
        rest: surface at the start of the motion [m].
        steps: of the states, (T,).
        x, v: particles [m], [m/s], (T, N, 3).
    """
    matrix = skinning_matrix(rest.vertices, x[0])
    vertices, velocities = (
        np.stack([matrix @ state.astype(np.float64) for state in states]).astype(np.float32)
        for states in (x, v)
    )
    return Surfaces(np.asarray(steps), vertices, velocities)
