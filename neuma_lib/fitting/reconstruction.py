"""Reconstruct a body from images of it at rest: Gaussians, surface, particles, binding (paper Sec. 3.1-3.4)."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal

import torch
from pydantic import Field

from neuma_lib.config.base import Section
from neuma_lib.config.binding import BindingConfig
from neuma_lib.config.gaussians import GaussiansConfig
from neuma_lib.config.geometry import SurfaceConfig
from neuma_lib.config.photographs import PhotographsConfig
from neuma_lib.config.validation import validate
from neuma_lib.coupling.particle_binding import bind_two_pass
from neuma_lib.coupling.reconstruction import Reconstruction
from neuma_lib.fitting.gaussians import fit_gaussians
from neuma_lib.geometry.surface import photographed, reconstruct
from neuma_lib.geometry.volume import sample_volume
from neuma_lib.io.photographs import load_static
from neuma_lib.mechanics.density import Density, density_at


class ReconstructionOptions(Section):
    """Options of `from_images`, with the sections of the settings that they are taken from."""

    photographs: PhotographsConfig = PhotographsConfig()
    gaussians: GaussiansConfig = GaussiansConfig()
    surface: SurfaceConfig = SurfaceConfig()
    binding: BindingConfig = BindingConfig()
    particles: int = Field(2000, gt=0)
    sampling: Literal["jittered", "uniform"] = "jittered"
    seed: int = 0


def from_images(
    transforms: str | Path, density: Density, options: Mapping[str, Any] | None = None
) -> Reconstruction:
    """`Reconstruction.from_images`."""
    chosen = validate(ReconstructionOptions, dict(options or {}), "options")
    views = load_static(transforms, chosen.photographs)
    gaussians, _ = fit_gaussians(
        views.images,
        views.cameras,
        chosen.gaussians,
        seed=chosen.seed,
        floor=views.floor,
        gain_rate=views.photographs.gain_rate if views.photographs else 0.0,
    )
    mesh = reconstruct(gaussians, views.cameras, views.images, chosen.surface, views.floor)
    if views.photographs:
        mesh = photographed(mesh, views.photographs.edge, views.floor)
    x = torch.from_numpy(sample_volume(mesh, chosen.particles, chosen.seed, chosen.sampling)).float()
    binding, x, _, vol0 = bind_two_pass(
        gaussians.means, gaussians.covars(), x, float(mesh.volume), chosen.binding
    )
    body = Reconstruction(x, vol0, vol0 * density_at(x, density), gaussians, binding)
    return body.to(torch.float32)
