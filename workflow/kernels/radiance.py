"""Kernels of voxel radiance fields."""

from __future__ import annotations

import torch

from neuma_lib.methods.pac_nerf.field import RadianceField
from neuma_lib.methods.pac_nerf.lattice import Lattice
from neuma_lib.methods.pac_nerf.rendering import Opacity


def compile_kernels(device: torch.device) -> None:
    """A ray through the particles of a small field, forward and backward, in both precisions."""
    for dtype in (torch.float32, torch.float64):
        field = RadianceField(Lattice((0.0, 0.0, 0.0), 0.5, (3, 3, 3)), Opacity(0.5, 0.5)).to(device, dtype)
        ray = torch.tensor([[0.5, 0.5, -1.0]]), torch.tensor([[0.0, 0.0, 1.0]])
        colours, _ = field.render(
            *field.particles(0.5, 0.0).seen(), *(part.to(device, dtype) for part in ray)
        )
        colours.sum().backward()
