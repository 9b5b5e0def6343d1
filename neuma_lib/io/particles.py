"""Reconstructed bodies: particles, the Gaussians bound to them, their start and their motion."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch

from neuma_lib.coupling.binding import Binding
from neuma_lib.coupling.reconstruction import Reconstruction
from neuma_lib.errors import InputError
from neuma_lib.io.files import read_json
from neuma_lib.io.gaussians import load_gaussians
from neuma_lib.io.hdf5 import read_arrays, write_arrays
from neuma_lib.mechanics.density import Density, density_at
from neuma_lib.sim.model import each_its_own


def save_binding(
    path: str | Path, binding: Binding, x: torch.Tensor, vol0: torch.Tensor, attributes: Mapping[str, Any]
) -> None:
    """Write a binding with the particles that it binds to: x (N, 3) [m], vol0 (N,) [m^3]."""
    arrays = {
        "indptr": binding.indptr,
        "indices": binding.indices,
        "values": binding.values,
        "x": x,
        "vol0": vol0,
    }
    arrays = {name: tensor.cpu().numpy() for name, tensor in arrays.items()}
    write_arrays(path, arrays, {"gaussians": binding.shape[0], "particles": binding.shape[1], **attributes})


def load_body(binding: str | Path, gaussians: str | Path, density: Density) -> Reconstruction:
    """The reconstructed body: bound particles with their volumes, and the Gaussians that they carry.

    Args:
        binding, gaussians: files of a scene, or of an experiment.
        density: what is known of it, or believed.

    Raises:
        InputError: the binding was made for other Gaussians.
    """
    kernels = load_gaussians(gaussians)
    arrays, attributes = read_arrays(binding, required=("indptr", "indices", "values", "x", "vol0"))
    if attributes.get("gaussians") != len(kernels):
        raise InputError(
            f"{binding} binds {attributes.get('gaussians')} Gaussians, {gaussians} has {len(kernels)}: run the rule"
            " binding again"
        )
    tensors = {name: torch.from_numpy(array) for name, array in arrays.items()}
    shape = (len(kernels), len(arrays["x"]))
    return Reconstruction(
        x0=tensors["x"],
        vol0=tensors["vol0"],
        mass=tensors["vol0"] * density_at(tensors["x"], density),
        gaussians=kernels,
        binding=Binding(tensors["indptr"], tensors["indices"], tensors["values"], shape),
    )


def load_start(
    binding: str | Path, gaussians: str | Path, velocity: str | Path, densities: Sequence[Density]
) -> tuple[Reconstruction, torch.Tensor, list[int]]:
    """What a prediction starts from: the reconstructed bodies of a scene (one) or of an experiment.

    Args:
        binding, gaussians, velocity: files of the scene or experiment.
        densities: of each body.

    Returns:
        All bodies as one, velocities of the particles [m/s] (N, 3), and the particle count of each body.
    """
    together = load_body(binding, gaussians, 1.0)
    found = read_json(velocity)
    parts = found.get("bodies", [{**found, "particles": len(together.x0)}])
    counts = [part["particles"] for part in parts]
    if sum(counts) != len(together.x0) or len(densities) != len(counts):
        raise InputError(f"{velocity} is of other bodies than {binding}: make both again")
    density = [density_at(x, d) for x, d in zip(together.x0.split(counts), densities, strict=True)]
    body = replace(together, mass=together.vol0 * torch.cat(density))
    return body, each_its_own([part["v0"] for part in parts], counts), counts


def load_motion(rollout: str | Path) -> tuple[torch.Tensor, torch.Tensor]:
    """What renders need of a rollout: positions (T, N, 3) [m], and deformations (T, N, 3, 3) that stretch Gaussians.

    These are elastic, or the total ones where the method says so and the file has them.
    """
    arrays, _ = read_arrays(rollout, required=("x", "F"), only=("x", "F", "F_total"))
    return torch.from_numpy(arrays["x"]), torch.from_numpy(arrays.get("F_total", arrays["F"]))
