"""A voxel radiance field, and the particles that represent it in a simulation (PAC-NeRF, Li et al. 2023, Sec. 3).

The raw density of a particle determines its appearance. Its opacity over one interval scales its mass and stiffness, so
that the diffuse shell of a field is light and soft.
"""

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor, nn

from neuma_lib.errors import InputError
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
"""Refinement keeps the nodes with at least this share of the largest opacity and their neighbours (an absolute opacity
in PAC-NeRF)."""
STIFFNESS_POWER = 3  # stiffness scales with this power of the opacity of a particle (PAC-NeRF's code)
MAX_NODES = 20_000_000
"""Nodes of a lattice, of 52 bytes each, three times as many with those of the optimiser."""
WHITE = (1.0, 1.0, 1.0)


@dataclass(frozen=True)
class FieldParticles:
    """Particles of a field for a simulation."""

    x: Tensor  # positions [m], (N, 3)
    features: Tensor  # raw density and colour features, (N, 1 + C)
    opacities: Tensor  # opacities over one interval, (N,), which scale mass and stiffness
    volume: float  # volume of space per particle [m^3]
    voxel: float  # voxel of the lattice that renders them [m]

    def masses(self, density: float) -> Tensor:
        """alpha rho V [kg], (N,), for a body of density rho [kg/m^3]."""
        return self.opacities * density * self.volume

    def volumes(self) -> Tensor:
        """alpha^3 V [m^3], (N,): rest volumes that scale the forces of a law by alpha^3.

        The force of a particle is its rest volume times its Kirchhoff stress, which is linear in the moduli. This does
        not change the yield strain, which grows as alpha^-3 in the authors' code because it scales only the moduli.
        """
        return self.opacities**STIFFNESS_POWER * self.volume

    def seen(self, x: Tensor | None = None) -> tuple[Lattice, Tensor]:
        """Lattice around the particles, optionally at other positions (N, 3), and its values, for `render`."""
        x = self.x if x is None else x
        lattice = Lattice.spanning(x.amin(0), x.amax(0), self.voxel)
        return lattice, from_particles(lattice, x, self.features)


class RadianceField(nn.Module):
    """Raw densities and colour features at the nodes of a lattice, and the network that maps features to colours.

    Attributes:
        lattice: positions of the nodes.
        opacity: activation of the density.
        density: raw densities (X, Y, Z, 1).
        features: colour features (X, Y, Z, C).
        network: colour network.
    """

    def __init__(self, lattice: Lattice, opacity: Opacity, network: ColourNetwork | None = None):
        super().__init__()
        if math.prod(lattice.nodes) > MAX_NODES:
            raise InputError(
                "lattice",
                f"its {' x '.join(map(str, lattice.nodes))} nodes exceed {MAX_NODES}",
                "Set a larger radiance.voxel, fewer radiance.halvings or fewer radiance.particles",
            )
        self.lattice, self.opacity = lattice, opacity
        self.network = ColourNetwork() if network is None else network
        self.density = nn.Parameter(torch.zeros(*lattice.nodes, 1))
        self.features = nn.Parameter(torch.zeros(*lattice.nodes, FEATURES))

    @classmethod
    def of_state(
        cls,
        lattice: Lattice,
        opacity: Opacity,
        state: Mapping[str, Tensor],
        network: ColourNetwork | None = None,
    ) -> "RadianceField":
        """Inverse of ``state_dict``. Raises ValueError, before nodes are allocated, if these are not the lattice's."""
        if tuple(state["density"].shape) != (*lattice.nodes, 1):
            raise ValueError(f"densities of shape {tuple(state['density'].shape)} on {lattice.nodes} nodes")
        field = cls(lattice, opacity, network).to(state["density"])
        field.load_state_dict(state)
        return field

    def values(self) -> Tensor:
        """Raw density and features, (X, Y, Z, 1 + C)."""
        return torch.cat([self.density, self.features], dim=3)

    @torch.no_grad()
    def occupied(self, share: float) -> Tensor:
        """Mask (X, Y, Z) of the nodes with at least a share of the largest opacity, and of their neighbours."""
        alphas = self.opacity(self.density[..., 0], 1.0)
        near = nn.functional.max_pool3d(alphas[None, None], kernel_size=3, stride=1, padding=1)[0, 0]
        return near >= share * alphas.max()

    @torch.no_grad()
    def halved(self) -> "RadianceField":
        """The occupied part of the field on a lattice of half the voxel size, with the same network."""
        nodes, lattice = self.occupied(OCCUPIED).nonzero(), self.lattice
        low = nodes.amin(0).clamp(max=torch.tensor(lattice.nodes, device=nodes.device) - 2)
        spans = (nodes.amax(0) - low).clamp(min=1)
        origin = tuple(o + lattice.voxel * k for o, k in zip(lattice.origin, low.tolist(), strict=True))
        refined = Lattice(origin, lattice.voxel / 2, tuple(2 * n + 1 for n in spans.tolist()))
        field = RadianceField(refined, self.opacity, self.network).to(self.density)
        values = interpolate(lattice, self.values(), refined.points(self.density).view(-1, 3))
        field.density.copy_(values[:, :1].view_as(field.density))
        field.features.copy_(values[:, 1:].view_as(field.features))
        return field

    def particles(
        self, spacing: float, min_opacity: float, generator: torch.Generator | None = None
    ) -> FieldParticles:
        """Particles in the occupied part, one at a random position in each cell of a cubic grid.

        Their features and opacities are differentiable with respect to the field.

        Args:
            spacing: side of a cell [voxels]; PAC-NeRF uses 0.5, i.e. eight particles per voxel.
            min_opacity: particles with less than this share of the largest opacity are omitted.
            generator: generator of the positions, on the CPU. None always gives the same positions.
        """
        generator = torch.Generator().manual_seed(0) if generator is None else generator
        voxel, like = self.lattice.voxel, self.density
        counts = [max(1, int((n - 1) / spacing + 1e-6)) for n in self.lattice.nodes]
        ticks = [spacing * torch.arange(count, dtype=like.dtype, device=like.device) for count in counts]
        cells = torch.cartesian_prod(*ticks)
        cells = cells[self.occupied(min_opacity)[tuple((cells + spacing / 2).round().long().unbind(1))]]
        jitter = torch.rand(len(cells), 3, generator=generator).to(like)
        x = torch.tensor(self.lattice.origin).to(like) + voxel * (cells + spacing * jitter)
        features = interpolate(self.lattice, self.values(), x)
        opacities = self.opacity(features[:, 0], 1.0)
        kept = (opacities >= min_opacity * opacities.max()).detach().nonzero()[:, 0]
        return FieldParticles(x[kept], features[kept], opacities[kept], (spacing * voxel) ** 3, voxel)

    def render(
        self,
        lattice: Lattice,
        values: Tensor,
        origins: Tensor,
        directions: Tensor,
        background: Sequence[float] = WHITE,
    ) -> tuple[Tensor, Tensor]:
        """`rendering.render` of values on a lattice, of the field or of particles, with the colours of the field."""
        return render(lattice, values, self.opacity, self.network, origins, directions, background)

    def render_in_pieces(
        self,
        lattice: Lattice,
        values: Tensor,
        origins: Tensor,
        directions: Tensor,
        background: Sequence[float] = WHITE,
    ) -> Iterator[tuple[slice, Tensor, Tensor]]:
        """`rendering.render_in_pieces` with the colours of the field."""
        return render_in_pieces(lattice, values, self.opacity, self.network, origins, directions, background)

    @torch.no_grad()
    def draw(
        self,
        cameras: Cameras,
        view: int,
        particles: FieldParticles | None = None,
        background: Sequence[float] = WHITE,
    ) -> Tensor:
        """Image (H, W, 3) of the field, or of its particles at their positions.

        In addition to rays and image, it needs memory for `rendering.POINTS_AT_ONCE` points.
        """
        lattice, values = (self.lattice, self.values()) if particles is None else particles.seen()
        pieces = self.render_in_pieces(lattice, values, *camera_rays(cameras, view), background)
        return torch.cat([colours for _, colours, _ in pieces]).view(cameras.height, cameras.width, 3)
