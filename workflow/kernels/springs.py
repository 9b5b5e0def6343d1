"""Kernels of networks of springs."""

import torch

from neuma_lib.methods.spring_gaus.network import SpringNetwork, Springs
from neuma_lib.methods.spring_gaus.rollout import SpringModel, spring_rollout


def compile_kernels(device: torch.device) -> None:
    """A rollout of two steps, forward and backward."""
    x = 0.4 + 0.2 * torch.rand(8, 3, generator=torch.Generator().manual_seed(0)).to(device)
    springs = Springs(SpringNetwork.of(x, 4, 2), 100.0, 0.1)
    path, *_ = spring_rollout(SpringModel(1e-3, (0.0, -9.8, 0.0), 0.0, 1.0), springs, x, 0 * x, (2,))
    path.sum().backward()
