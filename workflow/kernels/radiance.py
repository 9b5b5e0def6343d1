"""Kernels of voxel radiance fields, and of the gradient of analytic laws that are fitted to them."""

import torch

from neuma_lib.mechanics.analytic import analytic_law
from neuma_lib.methods.pac_nerf.field import RadianceField
from neuma_lib.methods.pac_nerf.lattice import Lattice
from neuma_lib.methods.pac_nerf.rendering import Opacity
from workflow.kernels.simulation import SPEC, simulate


def compile_kernels(device: torch.device) -> None:
    """A ray through the particles of a small field and a rollout of an analytic law, forward and backward."""
    field = RadianceField(Lattice((0.0, 0.0, 0.0), 0.5, (3, 3, 3)), Opacity(0.5, 0.5)).to(device)
    ray = torch.tensor([[0.5, 0.5, -1.0]]), torch.tensor([[0.0, 0.0, 1.0]])
    colours, _ = field.render(*field.particles(0.5, 0.0).seen(), *(part.to(device) for part in ray))
    colours.sum().backward()
    simulate(analytic_law(SPEC), device, gradient=True)
