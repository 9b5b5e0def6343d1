"""A radiance field represented by particles in a simulation, and its images (PAC-NeRF, Li et al. 2023, Sec. 3.2)."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from neuma_lib.coupling.interpolation import Interpolation
from neuma_lib.errors import InputError
from neuma_lib.mechanics.density import Density, density_at
from neuma_lib.methods.pac_nerf.field import WHITE, RadianceField
from neuma_lib.methods.pac_nerf.io import load_field
from neuma_lib.methods.pac_nerf.options import PacNerfConfig
from neuma_lib.sim.state import State
from neuma_lib.splatting.cameras import Cameras


class CarriedField:
    """A field represented by particles, some of which are simulated while the others follow.

    Args:
        field: field of the first stage.
        spacing, min_opacity: arguments of `RadianceField.particles` for the rendered particles.
        settings: number of simulated particles.
        density: density of the body [kg/m^3].

    Raises:
        InputError: the field has no particles.
    """

    def __init__(
        self,
        field: RadianceField,
        spacing: float,
        min_opacity: float,
        settings: PacNerfConfig,
        density: Density,
    ):
        self.field = field.requires_grad_(False)
        self.rendered = field.particles(spacing, min_opacity)
        if not len(self.rendered.x):
            raise InputError("radiance field", "it has no particles", "Run the rule radiance_field again")
        coarser = max(1.0, (len(self.rendered.x) / settings.particles) ** (1 / 3))
        self.moving = field.particles(coarser * spacing, max(min_opacity, settings.min_opacity))
        self.mass = self.moving.masses(density_at(self.moving.x, density))
        self._follow = Interpolation(self.rendered.x, self.moving.x, settings.followed)

    @classmethod
    def load(
        cls, path: str | Path, own: Mapping[str, Any], density: Density, device: torch.device | str = "cpu"
    ) -> "CarriedField":
        """The field of a file with the options ``own`` of the method: ``spacing``, ``min_opacity`` and ``settings`` (a
        `PacNerfConfig` as plain values).
        """
        field, _ = load_field(path)
        return cls(
            field.to(device), own["spacing"], own["min_opacity"], PacNerfConfig(**own["settings"]), density
        )

    def state(
        self,
        v0: Sequence[float] | Tensor,
        spin: Sequence[float] | Tensor = (0.0, 0.0, 0.0),
        centre: Sequence[float] | Tensor | None = None,
    ) -> State:
        """The simulated particles with the velocity v0 [m/s] and the spin [rad/s] of `State.rigid`."""
        return State.rigid(self.moving.x, self.mass, self.moving.volumes(), v0, spin, centre)

    def positions(self, x: Tensor) -> Tensor:
        """Positions of the rendered particles (T, N, 3) [m] for those of the simulated ones (T, A, 3)."""
        return self._follow(x)[0]

    def particle_gs(self, cameras: Cameras, background: Sequence[float] = WHITE) -> "FieldRenderer":
        """The renderer of this body for the given cameras, see `Reconstruction.particle_gs`."""
        return FieldRenderer(self, cameras, background)


class FieldRenderer:
    """Renders the states of a carried field, with the interface of `ParticleGS`.

    Args:
        body: the field.
        cameras: V views.
        background: colour of the background.
    """

    frames_per_batch = 1
    """Every frame has its own lattice."""

    def __init__(self, body: CarriedField, cameras: Cameras, background: Sequence[float] = WHITE):
        self.body, self.background = body, background
        self.cameras = cameras.to(body.rendered.x.device, body.rendered.x.dtype)

    def __call__(self, x: Tensor, F: Tensor | None = None) -> Tensor:
        """Images (T, V, H, W, 3) in [0, 1] for simulated particles at x (T, A, 3) [m]. The deformations F are ignored.

        Raises:
            InputError: the number of particles is not that of this field.
        """
        moving = self.body.moving.x
        if x.shape[1:] != moving.shape:
            problem = f"{x.shape[1]} particles must be the {len(moving)} simulated ones of the field"
            raise InputError("rollout", problem, "Run the evaluation again")
        field, particles = self.body.field, self.body.rendered
        positions = self.body.positions(x.to(moving))
        views = range(len(self.cameras))
        images = [
            field.draw(self.cameras, view, replace(particles, x=at), self.background)
            for at in positions
            for view in views
        ]
        return torch.stack(images).unflatten(0, (len(positions), len(views)))

    def batches(self, x: Tensor, F: Tensor, size: int | None = None) -> Iterator[tuple[slice, Tensor]]:
        """Render ``size`` frames at a time: yields (slice of frames, images)."""
        size = size or self.frames_per_batch
        for start in range(0, len(x), size):
            part = slice(start, min(start + size, len(x)))
            yield part, self(x[part])
