"""What several tests share of materials."""

import torch

from neuma_lib.mechanics.law import Constitutive

E, NU = 1e5, 0.3
EYE = torch.eye(3, dtype=torch.float64)


def rotations(count: int, seed: int = 0) -> torch.Tensor:
    generator = torch.Generator().manual_seed(seed)
    Q, R = torch.linalg.qr(torch.randn(count, 3, 3, generator=generator, dtype=torch.float64))
    Q = Q * R.diagonal(dim1=1, dim2=2).sign()[:, None]
    return Q * torch.linalg.det(Q)[:, None, None]


def deformations(count: int = 400, size: float = 0.15, seed: int = 1) -> torch.Tensor:
    """Random rotations times stretches with random log strains of the given size."""
    generator = torch.Generator().manual_seed(seed)
    strain = size * torch.randn(count, 3, generator=generator, dtype=torch.float64)
    return (rotations(count, seed + 1) * strain.exp()[:, None]) @ rotations(count, seed + 2)


def weights_of(part: Constitutive, dtype=torch.float64) -> tuple[torch.Tensor, ...]:
    return tuple(w.detach().to(dtype) for w in part.weights())


def hencky_deviator(F: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Trace and deviator (N, 3) of the log strain, through a separate eigenvalue solver."""
    strain = 0.5 * torch.linalg.eigvalsh(F.mT @ F).log()
    trace = strain.sum(1, keepdim=True)
    return trace, strain - trace / 3
