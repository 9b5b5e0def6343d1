"""A reconstructed body: particles, Gaussians and their binding."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from neuma_lib.config.binding import BindingConfig
from neuma_lib.coupling.binding import Binding
from neuma_lib.coupling.particle_binding import bind_two_pass
from neuma_lib.coupling.particle_gs import ParticleGS
from neuma_lib.mechanics.density import Density, density_at
from neuma_lib.sim.state import State
from neuma_lib.splatting.cameras import Cameras
from neuma_lib.splatting.gaussians import Gaussians


@dataclass(frozen=True)
class Reconstruction:
    """A reconstructed object at t = 0.

    Attributes:
        x0: particle positions [m], shape (N, 3).
        vol0: particle volumes [m^3], shape (N,).
        mass: particle masses [kg], shape (N,).
        gaussians: static Gaussians, G of them.
        binding: (G, N) binding matrix.
        affine: Gaussians follow the affine motion of their particles, not only the mean displacement (`deform`).
    """

    x0: Tensor
    vol0: Tensor
    mass: Tensor
    gaussians: Gaussians
    binding: Binding
    affine: bool = False

    @classmethod
    def from_images(
        cls, transforms: str | Path, density: Density, options: Mapping[str, Any] | None = None
    ) -> Reconstruction:
        """Reconstruct an object from views of it at rest.

        Fits Gaussians to the images, extracts a watertight surface, fills it with particles and binds the Gaussians to
        them. The work is done on the CPU.

        Args:
            transforms: ``transforms.json`` with cameras and RGBA images, whose alpha shows the object alone.
            density: density [kg/m^3], or two densities on either side of a plane.
            options: ``particles`` (number, default 2000), ``seed``, ``sampling``, and values of the sections
                ``gaussians``, ``photographs``, ``surface`` and ``binding`` of the settings.

        Raises:
            InputError: a file or an option is invalid, or the views do not show one body.
            NonFiniteError: the fit of the Gaussians diverges.

        Example:
            >>> body = Reconstruction.from_images("data/JellyDuck/static/transforms.json", density=1000.0)
        """
        # Imported by name, because the fit needs this class.
        return import_module("neuma_lib.fitting.reconstruction").from_images(transforms, density, options)

    @classmethod
    def of_gaussians(cls, gaussians: Gaussians, volume: float, density: Density) -> Reconstruction:
        """One particle per Gaussian (the paper's w/o Bind), with equal shares of the volume [m^3]."""
        count = len(gaussians.means)
        vol0 = torch.full_like(gaussians.means[:, 0], volume / count)
        mass = vol0 * density_at(gaussians.means, density)
        return cls(gaussians.means, vol0, mass, gaussians, Binding.identity(count, gaussians.means))

    def resampled(
        self, x: Tensor, volume: float, density: Density, settings: BindingConfig | None = None
    ) -> Reconstruction:
        """The same Gaussians with other particles x (N', 3) [m], which have equal shares of a volume [m^3]."""
        gaussians = self.gaussians
        binding, x0, _, vol0 = bind_two_pass(gaussians.means, gaussians.covars(), x, volume, settings)
        x0, vol0 = x0.to(self.x0), vol0.to(self.x0)
        binding = binding.to(dtype=self.x0.dtype, device=self.x0.device)
        return replace(self, x0=x0, vol0=vol0, mass=vol0 * density_at(x0, density), binding=binding)

    def state(
        self,
        v0: Sequence[float] | np.ndarray | Tensor,
        spin: Sequence[float] | np.ndarray | Tensor = (0.0, 0.0, 0.0),
        centre: Sequence[float] | np.ndarray | Tensor | None = None,
    ) -> State:
        """The particles at t = 0 with velocity v0 [m/s] and angular velocity ``spin`` [rad/s] (`State.rigid`)."""
        return State.rigid(self.x0, self.mass, self.vol0, v0, spin, centre)

    def to(self, dtype: torch.dtype, device: torch.device | str | None = None) -> Reconstruction:
        """The same body with another dtype or on another device."""
        kind = dict(dtype=dtype, device=device)
        values = {field.name: getattr(self, field.name) for field in fields(self)}
        return replace(self, **{
            name: value if isinstance(value, bool) else value.to(**kind) for name, value in values.items()
        })  # fmt: skip

    def particle_gs(self, cameras: Cameras, **options) -> ParticleGS:
        """The renderer of this body for the given cameras."""
        return ParticleGS(self.gaussians, self.binding, self.x0, cameras, affine=self.affine, **options)
