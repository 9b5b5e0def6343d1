"""What several tests share of binding."""

import torch


def random_gaussians(count, seed, spread=1.0, size=0.05, anisotropy=1.0, dtype=torch.float64):
    """Centres in a cube and covariances with scales over ``exp(+-anisotropy)``."""
    generator = torch.Generator().manual_seed(seed)
    means = torch.rand(count, 3, generator=generator, dtype=dtype) * spread
    scales = size * torch.exp(anisotropy * (2 * torch.rand(count, 3, generator=generator, dtype=dtype) - 1))
    rotations = torch.linalg.qr(torch.randn(count, 3, 3, generator=generator, dtype=dtype))[0]
    return means, rotations @ torch.diag_embed(scales**2) @ rotations.transpose(1, 2)


def random_particles(count, seed, spread=1.0, dtype=torch.float64):
    return torch.rand(count, 3, generator=torch.Generator().manual_seed(seed), dtype=dtype) * spread
