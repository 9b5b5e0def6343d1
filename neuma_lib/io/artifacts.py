"""Objects of the library from artifacts on disk, and back: `io` deals in arrays, this in bodies, laws and videos."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from neuma_lib.coupling.binding import Binding
from neuma_lib.coupling.reconstruction import Reconstruction
from neuma_lib.errors import InputError
from neuma_lib.io.files import read_json
from neuma_lib.io.hdf5 import read_arrays, write_arrays
from neuma_lib.io.images import ImageSet, read_image_set
from neuma_lib.io.laws import load_prior
from neuma_lib.io.ply import read_gaussians, write_gaussians
from neuma_lib.io.weights import read_weights, write_weights
from neuma_lib.mechanics.density import Density, density_at
from neuma_lib.mechanics.neural import NeuralLaw
from neuma_lib.sim.model import each_its_own
from neuma_lib.splatting.cameras import Cameras
from neuma_lib.splatting.gaussians import Gaussians
from neuma_lib.splatting.observation import Observation


def load_views(transforms: str | Path, views: Sequence[int] | None = None) -> tuple[torch.Tensor, Cameras]:
    """Straight-alpha RGBA images (V, H, W, 4) in [0, 1] and their cameras, of an image set at one time."""
    images = read_image_set(transforms, views)
    pixels = torch.from_numpy(images.images).float() / 255
    return pixels, _cameras(images, np.arange(len(pixels)))


def load_observation(transforms: str | Path, views: Sequence[int]) -> Observation:
    """The video of some views, with its pixels as they are stored: 1 GB for 400 frames of 800 x 800."""
    images = read_image_set(transforms, views)
    frames, index, columns = images.video(views)
    return Observation(frames, torch.from_numpy(images.images[index]), _cameras(images, columns))


def _cameras(images: ImageSet, index: np.ndarray) -> Cameras:
    return Cameras(
        torch.from_numpy(images.viewmats[index]).float(),
        torch.from_numpy(images.Ks[index]).float(),
        images.width,
        images.height,
    )


def save_gaussians(path: str | Path, gaussians: Gaussians) -> None:
    """Write Gaussians in the 3DGS layout."""
    names = ("means", "quats", "scales", "opacities", "sh0", "shN")
    write_gaussians(path, **{name: getattr(gaussians, name).detach().cpu().numpy() for name in names})


def load_gaussians(path: str | Path) -> Gaussians:
    """Read Gaussians in the 3DGS layout."""
    return Gaussians(**{name: torch.from_numpy(array) for name, array in read_gaussians(path).items()})


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


def save_adaptor(
    path: str | Path, law: NeuralLaw, rank: int | None, alpha: float, metadata: Mapping[str, Any]
) -> None:
    """Write the tensors of a law's adaptor, with what is needed to attach them again."""
    write_weights(path, law.adaptor_state(), {"rank": rank, "alpha": alpha, **metadata})


def load_law(prior: str | Path, adaptor: str | Path | None = None) -> NeuralLaw:
    """A prior, with a trained adaptor attached if one is given."""
    law = load_prior(prior)
    if adaptor is not None:
        tensors, metadata = read_weights(adaptor)
        if "rank" not in metadata or "alpha" not in metadata:
            raise InputError(
                f"{adaptor} has no rank and alpha in its metadata: it is not an adaptor of this project"
            )
        law.load_adaptor_state(tensors, rank=metadata["rank"], alpha=metadata["alpha"])
    return law
