"""A voxel radiance field, and the particles that carry it into a simulation (PAC-NeRF, Li et al. 2023, Sec. 3).

The raw density of a particle decides what is seen of it, and its opacity over one interval how heavy and how stiff it
is: the fuzzy shell of a field is light and soft.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor, nn

from neuma_lib.methods.pac_nerf.lattice import Lattice, from_particles, interpolate
from neuma_lib.methods.pac_nerf.rendering import (
    FEATURES,
    ColourNetwork,
    Opacity,
    camera_rays,
    render,
    render_in_pieces,
)
from neuma_lib.splatting.cameras import Cameras

OCCUPIED = 1e-7
"""A halved lattice keeps the nodes that have at least this part of the largest opacity, and those next to them
(PAC-NeRF: this opacity)."""
STIFFNESS_POWER = 3
"""Stiffness is that of the material times this power of a particle's opacity (PAC-NeRF's code)."""
WHITE = (1.0, 1.0, 1.0)


@dataclass(frozen=True)
class FieldParticles:
    """What a field hands to a simulation.

    Attributes:
        x: positions [m], (N, 3).
        features: raw density and colour features, (N, 1 + C).
        opacities: over one interval, (N,), which weigh mass and stiffness.
        volume: of space that each stands for [m^3].
        voxel: of the lattice that they are seen on [m].
    """

    x: Tensor
    features: Tensor
    opacities: Tensor
    volume: float
    voxel: float

    def masses(self, density: float) -> Tensor:
        """alpha rho V [kg], (N,), of a body of the density rho [kg/m^3]."""
        return self.opacities * density * self.volume

    def volumes(self) -> Tensor:
        """alpha^3 V [m^3], (N,): volumes at rest that give a law of full stiffness the force of alpha^3 of it.

        The force of a particle is its volume at rest times its Kirchhoff stress, and all stresses here are linear in
        the moduli. Strains at yield stay as they are (the authors' code weighs the moduli and not the yield stress, so
        there they grow as alpha^-3 in the shell).
        """
        return self.opacities**STIFFNESS_POWER * self.volume

    def seen(self, x: Tensor | None = None) -> tuple[Lattice, Tensor]:
        """The lattice about the particles, where they are or at other positions (N, 3), and its values, to `render`."""
        x = self.x if x is None else x
        lattice = Lattice.spanning(x.amin(0), x.amax(0), self.voxel)
        return lattice, from_particles(lattice, x, self.features)


class RadianceField(nn.Module):
    """Raw densities and colour features at the nodes of a lattice, and the network that turns features into colours.

    Attributes:
        lattice: where the nodes are.
        opacity: activation of the density.
        density: (X, Y, Z, 1) raw.
        features: (X, Y, Z, C).
        network: the colours.
    """

    def __init__(self, lattice: Lattice, opacity: Opacity, network: ColourNetwork | None = None):
        super().__init__()
        self.lattice, self.opacity = lattice, opacity
        self.network = ColourNetwork() if network is None else network
        self.density = nn.Parameter(torch.zeros(*lattice.nodes, 1))
        self.features = nn.Parameter(torch.zeros(*lattice.nodes, FEATURES))

    def values(self) -> Tensor:
        """Raw density and features side by side, (X, Y, Z, 1 + C)."""
        return torch.cat([self.density, self.features], dim=3)

    @torch.no_grad()
    def occupied(self, least: float) -> Tensor:
        """Nodes (X, Y, Z) that have at least a part of the largest opacity, and those next to them."""
        alphas = self.opacity(self.density[..., 0], 1.0)
        near = nn.functional.max_pool3d(alphas[None, None], kernel_size=3, stride=1, padding=1)[0, 0]
        return near >= least * alphas.max()

    @torch.no_grad()
    def halved(self) -> RadianceField:
        """The occupied part of the field on a lattice of half the voxel, with the same network."""
        found, lattice = self.occupied(OCCUPIED).nonzero(), self.lattice
        low = found.amin(0).clamp(max=torch.tensor(lattice.nodes, device=found.device) - 2)
        spans = (found.amax(0) - low).clamp(min=1)
        origin = tuple(o + lattice.voxel * k for o, k in zip(lattice.origin, low.tolist(), strict=True))
        finer = Lattice(origin, lattice.voxel / 2, tuple(2 * n + 1 for n in spans.tolist()))
        field = RadianceField(finer, self.opacity, self.network).to(self.density)
        values = interpolate(lattice, self.values(), finer.points(self.density).view(-1, 3))
        field.density.copy_(values[:, :1].view_as(field.density))
        field.features.copy_(values[:, 1:].view_as(field.features))
        return field

    def particles(
        self, spacing: float, least_opacity: float, generator: torch.Generator | None = None
    ) -> FieldParticles:
        """Particles in the occupied part; their features and opacities are differentiable with respect to the field.

        One in each cell of a cubic grid, at a random place in it.

        Args:
            spacing: side of such a cell [voxels]; the authors take 0.5, eight particles a voxel.
            least_opacity: particles less opaque than this part of the most opaque one are left out.
            generator: of the places, on the CPU; None draws the same ones every time.
        """
        generator = torch.Generator().manual_seed(0) if generator is None else generator
        voxel, like = self.lattice.voxel, self.density
        counts = [max(1, int((n - 1) / spacing + 1e-6)) for n in self.lattice.nodes]
        ticks = [spacing * torch.arange(count, dtype=like.dtype, device=like.device) for count in counts]
        cells = torch.cartesian_prod(*ticks)
        cells = cells[self.occupied(least_opacity)[tuple((cells + spacing / 2).round().long().unbind(1))]]
        jitter = torch.rand(len(cells), 3, generator=generator).to(like)
        x = torch.tensor(self.lattice.origin).to(like) + voxel * (cells + spacing * jitter)
        features = interpolate(self.lattice, self.values(), x)
        opacities = self.opacity(features[:, 0], 1.0)
        kept = (opacities >= least_opacity * opacities.max()).detach().nonzero()[:, 0]
        return FieldParticles(x[kept], features[kept], opacities[kept], (spacing * voxel) ** 3, voxel)

    def render(
        self,
        lattice: Lattice,
        values: Tensor,
        origins: Tensor,
        directions: Tensor,
        background: Sequence[float] = WHITE,
    ) -> tuple[Tensor, Tensor]:
        """`rendering.render` of values on a lattice, those of the field or of particles, in the field's colours."""
        return render(lattice, values, self.opacity, self.network, origins, directions, background)

    def render_in_pieces(
        self,
        lattice: Lattice,
        values: Tensor,
        origins: Tensor,
        directions: Tensor,
        background: Sequence[float] = WHITE,
    ) -> Iterator[tuple[slice, Tensor, Tensor]]:
        """`rendering.render_in_pieces`, likewise."""
        return render_in_pieces(lattice, values, self.opacity, self.network, origins, directions, background)

    @torch.no_grad()
    def draw(
        self,
        cameras: Cameras,
        view: int,
        particles: FieldParticles | None = None,
        background: Sequence[float] = WHITE,
    ) -> Tensor:
        """Picture (H, W, 3) of the field, or of the particles that carry it, where these are.

        Memory, beside rays and picture, is that of a piece (`rendering.POINTS_AT_ONCE`), whatever the picture's size.
        """
        lattice, values = (self.lattice, self.values()) if particles is None else particles.seen()
        pieces = self.render_in_pieces(lattice, values, *camera_rays(cameras, view), background)
        return torch.cat([colours for _, colours, _ in pieces]).view(cameras.height, cameras.width, 3)
