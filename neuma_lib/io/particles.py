"""Reconstructed bodies: particles, the Gaussians bound to them, initial motion and trajectory."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch

from neuma_lib.coupling.binding import Binding
from neuma_lib.coupling.reconstruction import Reconstruction
from neuma_lib.errors import InputError
from neuma_lib.io.files import read_json, reading
from neuma_lib.io.gaussians import load_gaussians
from neuma_lib.io.hdf5 import check_indices, read_arrays, write_arrays
from neuma_lib.mechanics.density import Density, density_at
from neuma_lib.sim.state import State

ParticleSource = Literal["binding", "gaussians"]
"""Simulated particles: the volume particles of the binding, or the Gaussians themselves."""
GaussianMotion = Literal["mean", "affine"]
"""How Gaussians follow their particles: by the mean displacement, or by the affine motion."""


def save_particles(
    path: str | Path, x: torch.Tensor, vol0: torch.Tensor, attributes: Mapping[str, Any]
) -> None:
    """Write the particles of a body: x (N, 3) [m], vol0 (N,) [m^3]."""
    write_arrays(path, {"x": x.cpu().numpy(), "vol0": vol0.cpu().numpy()}, attributes)


def load_particles(path: str | Path) -> tuple[torch.Tensor, torch.Tensor, dict[str, Any]]:
    """Particles of a body: x (N, 3) [m], vol0 (N,) [m^3], attributes of the file."""
    arrays, attributes = read_arrays(path, required=("x", "vol0"))
    return torch.from_numpy(arrays["x"]), torch.from_numpy(arrays["vol0"]), attributes


def save_binding(path: str | Path, binding: Binding) -> None:
    """Write a binding matrix."""
    arrays = {name: getattr(binding, name).cpu().numpy() for name in ("indptr", "indices", "values")}
    write_arrays(path, arrays, {"gaussians": binding.shape[0], "particles": binding.shape[1]})


def load_reconstruction(
    particles: str | Path,
    binding: str | Path,
    gaussians: str | Path,
    density: Density,
    particle_source: ParticleSource = "binding",
    gaussian_motion: GaussianMotion = "mean",
) -> Reconstruction:
    """The reconstructed body of a scene or experiment: particles with their volumes, and the Gaussians bound to them.

    With ``particle_source="gaussians"`` the Gaussians are the particles, with equal shares of the same volume. With
    ``gaussian_motion="affine"`` Gaussians follow the affine motion of their particles in renders.

    Raises:
        InputError: the binding belongs to other Gaussians or particles.
    """
    splats = load_gaussians(gaussians)
    x0, vol0, _ = load_particles(particles)
    if len(x0) == 0 or vol0.min() <= 0:
        raise InputError(particles, "has no particles, or a volume that is not positive", "Regenerate it")
    arrays, attributes = read_arrays(binding, required=("indptr", "indices", "values"))
    for kind, file, count in (("gaussians", gaussians, len(splats)), ("particles", particles, len(x0))):
        if attributes.get(kind) != count:
            problem = f"has {attributes.get(kind)} {kind}, but {file} has {count}"
            raise InputError(binding, problem, "Run the rule binding again")
    if particle_source == "gaussians":
        return Reconstruction.of_gaussians(splats, float(vol0.sum()), density)
    with reading(binding, "a binding"):
        _check_rows(arrays["indptr"], arrays["indices"], (len(splats), len(x0)))
    return Reconstruction(
        x0=x0,
        vol0=vol0,
        mass=vol0 * density_at(x0, density),
        gaussians=splats,
        binding=Binding(
            **{name: torch.from_numpy(array) for name, array in arrays.items()}, shape=(len(splats), len(x0))
        ),
        affine=gaussian_motion == "affine",
    )


def _check_rows(indptr: np.ndarray, indices: np.ndarray, shape: tuple[int, int]) -> None:
    """Check a sparse matrix of ``shape`` in CSR format. Raises ValueError."""
    check_indices("indices", indices, shape[1])
    if (
        len(indptr) != shape[0] + 1
        or indptr[0] != 0
        or indptr[-1] != len(indices)
        or (np.diff(indptr) < 0).any()
    ):
        raise ValueError(f"indptr must ascend from 0 to {len(indices)} in {shape[0]} rows")


INITIAL_MOTION = ("v0", "angular_velocity", "centre")
"""Keys of velocity.json: velocity of the centre [m/s], angular velocity about it [rad/s], centre [m]."""


def _initial_motion(file: str | Path) -> dict[str, Any]:
    """Content of velocity.json, or the entry ``start`` of identified.json, which has the same keys."""
    content = read_json(file)
    return content.get("start", content)


def with_motion(body: Reconstruction, velocity: str | Path) -> State:
    """State of a reconstructed body with its estimated initial motion, from velocity.json or identified.json."""
    motion = _initial_motion(velocity)
    return body.state(*(motion[key] for key in INITIAL_MOTION))


def with_motions(bodies: Sequence[Reconstruction], velocity: str | Path) -> State:
    """State of bodies that touch each other with the motions of the identified.json of all."""
    parts = _initial_motion(velocity)["bodies"]
    own = [
        body.state(*(part[key] for key in INITIAL_MOTION)) for body, part in zip(bodies, parts, strict=True)
    ]
    return State.joined(own, separate=True)


def load_initial_state(
    particles: str | Path,
    binding: str | Path,
    gaussians: str | Path,
    velocity: str | Path,
    densities: Sequence[Density],
    particle_source: ParticleSource = "binding",
) -> tuple[State, list[int]]:
    """Initial state of a prediction: the reconstructed bodies of a scene (one) or of an experiment.

    Returns:
        State of all bodies, one after the other, and the particle count of each.

    Raises:
        InputError: files of different bodies, or several bodies with Gaussians as particles.
    """
    together = load_reconstruction(particles, binding, gaussians, 1.0, particle_source)
    x0, vol0 = together.x0, together.vol0
    motion = _initial_motion(velocity)
    parts = motion.get("bodies") or [motion]
    if particle_source == "gaussians":
        if len(parts) > 1:
            problem = f"has {len(parts)} bodies, but the Gaussians can be the particles of one body only"
            raise InputError(velocity, problem, "Choose a method that is evaluated on particles")
    stated = particle_source != "gaussians" and "bodies" in motion
    counts = [part["particles"] for part in parts] if stated else [len(x0)]
    if sum(counts) != len(x0) or min(counts) < 1 or len(densities) != len(counts):
        raise InputError(velocity, f"does not have the bodies of {particles}", "Regenerate both")
    return State.joined([
        State.rigid(x, vol * density_at(x, density), vol, *(part[key] for key in INITIAL_MOTION))
        for x, vol, density, part in zip(x0.split(counts), vol0.split(counts), densities, parts, strict=True)
    ], motion.get("separate", False)), counts  # fmt: skip


def load_motion(rollout: str | Path) -> tuple[torch.Tensor, torch.Tensor]:
    """Positions (T, N, 3) [m] and deformation gradients (T, N, 3, 3) of a rollout, for renders.

    The deformation gradients are the total ones if the file has them, else the elastic ones.
    """
    arrays, _ = read_arrays(rollout, required=("x", "F"), only=("x", "F", "F_total"))
    return torch.from_numpy(arrays["x"]), torch.from_numpy(arrays.get("F_total", arrays["F"]))
