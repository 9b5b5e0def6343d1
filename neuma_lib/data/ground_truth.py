"""Ground truth of a synthetic benchmark: known shapes of known materials, simulated by the same MPM.

Only evaluation and the particle-supervised ablation may read it. It differs from the reconstruction in its particles
(more, with another seed) and its law (analytic). Integrator and contact are the same. Grid and time step are the same
by default, because the paper evaluates a law in the discretisation of its training. `dataset.grid`, `dataset.dt` and
`scenes.<name>.truth` refine the truth.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
import trimesh
from torch import Tensor

from neuma_lib.errors import InputError
from neuma_lib.geometry.volume import check_apart, sample_tracers, sample_volume, signed_distance
from neuma_lib.mechanics.density import Density, density_at
from neuma_lib.mechanics.law import Law
from neuma_lib.sim.model import MPM, consecutive
from neuma_lib.sim.rollout import rollout
from neuma_lib.sim.state import State, Trajectory

PER_CELL = 8  # particles in a cell of a converged truth


@dataclass(frozen=True)
class TrueBody:
    """A solid at its initial position."""

    mesh: trimesh.Trimesh  # surface, watertight [m]
    law: Law  # analytic material
    velocity: Sequence[float]  # initial velocity [m/s]
    density: Density = 1000.0  # mass density [kg/m^3], see `neuma_lib.mechanics.density`
    spin: Sequence[float] = (0.0, 0.0, 0.0)  # initial angular velocity about the centre of mass [rad/s]


@dataclass(frozen=True)
class GroundTruth:
    """Simulated bodies, with concatenated particles."""

    frames: tuple[int, ...]  # simulation steps of the frames, length T
    path: Trajectory  # particle states at the frames (x [m], v [m/s], F), N particles
    tracers: Tensor  # passive tracers from a jittered grid in the true shapes [m], shape (T, M, 3)
    # tracers from another jittered grid, shape (T, M', 3). Their distance to ``tracers`` is the sampling
    # floor of the Chamfer distance.
    tracers_again: Tensor
    vol0: Tensor  # particle volumes [m^3], shape (N,)
    mass: Tensor  # particle masses [kg], shape (N,)
    # body, tracer_body: index of the body of each particle (N,) and of each of ``tracers`` (M,)
    body: Tensor
    tracer_body: Tensor


def simulate_ground_truth(
    model: MPM,
    bodies: Sequence[TrueBody],
    frames: Sequence[int],
    *,
    particles: int | None,
    tracers: int,
    seed: int,
    stored: int | None = None,
    separate: bool = False,
    device: torch.device | str = "cpu",
) -> GroundTruth:
    """Fill bodies with particles and simulate them on one grid.

    Args:
        frames: steps to store, 0 is the start.
        particles: requested number in each body. None: `PER_CELL` in a cell.
        tracers: requested number in all bodies together, with uniform density.
        seed: of particle and tracer positions.
        stored: largest number of particles of each body in the result, which are drawn from all of them and represent
            their volume. None: all.
        separate: whether bodies touch each other with the friction of ``model.pairs``. Otherwise they stick where they
            share nodes of the grid.
        device: of the simulation; the result is on the CPU.

    Raises:
        InputError: a mesh is not watertight or outside the domain, bodies overlap, or the time step is too large for a
            law.
    """
    check_apart([body.mesh for body in bodies])
    solids = []
    for body in bodies:
        count = particles or round(PER_CELL * body.mesh.volume / model.dx**3)
        x = torch.as_tensor(sample_volume(body.mesh, count, seed=seed), dtype=torch.float32)
        density = density_at(x, body.density)
        model.check_courant(body.law, float(density.min()))
        vol0 = torch.full((len(x),), float(body.mesh.volume) / len(x))
        solids.append(State.rigid(x, vol0 * density, vol0, body.velocity, body.spin))
    surface = trimesh.util.concatenate([body.mesh for body in bodies])
    start = [
        torch.as_tensor(sample_tracers(surface, tracers, seed=seed + 1 + k), dtype=torch.float32)
        for k in range(2)
    ]
    passive = torch.cat(start)
    owner = _bodies_at([body.mesh for body in bodies], passive)
    by_body = torch.argsort(owner, stable=True) if separate else torch.arange(len(passive))
    together = State.joined(solids, separate)
    for k, collider in enumerate(model.colliders):
        inside = int((collider.surface(together.x)[0] < 0).sum())
        if inside:
            problem = f"the {collider.shape} contains {inside} of {len(together.x)} particles at the start"
            raise InputError(f"colliders.{k}", problem, "Move the obstacle or the body")
    with torch.no_grad():
        path = rollout(
            model,
            consecutive([body.law for body in bodies], [len(solid.x) for solid in solids]),
            together.to(device),
            steps=max(frames),
            frames=frames,
            tracers=passive[by_body].to(device),
            tracer_bodies=torch.bincount(owner, minlength=len(bodies)).tolist() if separate else (),
        ).cpu()
    moved = torch.empty_like(path.tracers)
    moved[:, by_body] = path.tracers
    split = len(start[0])
    counts, first, drawn, share = [len(solid.x) for solid in solids], 0, [], []
    for count in counts:
        kept = min(stored or count, count)
        order = np.random.default_rng(seed).permutation(count)[:kept]
        drawn.append(torch.from_numpy(first + np.sort(order)))
        share.append(torch.full((kept,), count / kept))
        first += count
    picked, represented = torch.cat(drawn), torch.cat(share)
    return GroundTruth(
        frames=tuple(frames),
        path=replace(path, **{name: getattr(path, name)[:, picked] for name in ("x", "v", "F", "C")}),
        tracers=moved[:, :split],
        tracers_again=moved[:, split:],
        vol0=represented * together.vol0[picked],
        mass=represented * together.mass[picked],
        body=torch.arange(len(bodies)).repeat_interleave(torch.tensor(counts))[picked],
        tracer_body=owner[:split],
    )


def _bodies_at(meshes: Sequence[trimesh.Trimesh], points: Tensor) -> Tensor:
    """Index (P,) of the solid that contains each point (P, 3) [m], the nearest one within round-off of the surfaces."""
    if len(meshes) == 1:
        return torch.zeros(len(points), dtype=torch.int64)
    distances = [signed_distance(mesh, points.double().numpy()) for mesh in meshes]
    return torch.from_numpy(np.argmin(distances, axis=0))


def change_by_a_doubled_grid(truth: GroundTruth, half: GroundTruth) -> float:
    """Estimated root mean square change of the tracers [m] if grid and number of steps of a truth were doubled.

    It is half the change from ``half``, the same truth of half the grid and half the steps, because the error of a
    truth is of first order in dx.
    """
    return 0.5 * float((half.tracers - truth.tracers).double().square().sum(-1).mean().sqrt())
