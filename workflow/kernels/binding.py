"""Kernel of the binding of Gaussians to particles."""

import torch

from neuma_lib.coupling.particle_binding import bind


def compile_kernels(device: torch.device) -> None:
    """A Gaussian and a particle, on the CPU, where the workflow binds whatever the device."""
    bind(torch.zeros(1, 3), torch.eye(3)[None], torch.zeros(1, 3))
